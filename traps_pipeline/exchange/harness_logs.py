"""Read answers by item from inspect_ai's or lmms-eval's logs, or plain lines.

They name an item and a regime, not a ledger key. The importing user says which model of the experiment answered, and in
which run. All of it is untrusted data: sizes are bounded, nothing is executed.
"""

import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from traps_pipeline.base.archives import BadArchive, reading_archive
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.yamlfile import read_lines
from traps_pipeline.models.reading.endings import ending_of
from traps_pipeline.models.request import UNFINISHED, WITH_TEXT
from traps_pipeline.models.wire.usage import Sizes, read_usage

MAX_SAMPLE_BYTES, MAX_LOG_BYTES, MAX_SAMPLES = 2**28, 2 * 2**30, 1_000_000
# Outcome by finish reason in a log; an error is asked again.
OUTCOMES = {"complete": "answer", "truncated": "truncated", "refused": "refused", "transient": "error"}
_ZSTD, _LOCAL_HEADER = 93, struct.Struct("<4s5H3I2H")
LOG = ".eval"  # suffix of inspect_ai's own log format
Reader = Callable[[Path], Iterator["LoggedAnswer"]]


@dataclass(frozen=True)
class LoggedAnswer:
    """An answer to an item from a harness's log.

    where: file and line or sample, for messages. item: its id, or its opaque name in a held-out set. answer: fields of
    `exchange.Answer` except its key. run: None if the file does not say. epoch: the harness's repetition, from 1.
    has_failed: the call brought no answer, so that the item stays missing.
    """

    where: str
    item: str
    regime: str
    run: int | None = None
    answer: dict[str, Any] = field(default_factory=dict)
    epoch: int = 1
    has_failed: bool = False


def log_reader(path: Path) -> Reader | None:
    """Return a reader of answers by item; None for answers by key, or a batch."""
    if path.suffix == LOG:
        return _eval_log
    if path.suffix == ".json":
        return _json_log
    first = next((line for _, line in read_lines(path)), "{}")
    try:
        names = {*json.loads(first)}
    except (ValueError, TypeError):
        return None
    if {"filtered_resps", "traps_pecs"} <= names:
        return _lmms_samples
    return _plain_lines if {"item", "regime"} <= names else None


# --- inspect_ai -------------------------------------------------------------------------------------------------------


def _json_log(path: Path) -> Iterator[LoggedAnswer]:
    try:
        if path.stat().st_size > MAX_LOG_BYTES:
            raise TrapsError(f"{path}: is larger than {MAX_LOG_BYTES} bytes; log it without images (--no-log-images)")
        log = json.loads(path.read_bytes())
        samples = log["samples"]
    except OSError as error:
        raise TrapsError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise TrapsError(f"{path}: is no log of inspect_ai with samples ({plain(error)[:200]})") from error
    for number, sample in enumerate(samples if isinstance(samples, list) else (), start=1):
        yield _sample(f"{path}: sample {number}", sample)


def _eval_log(path: Path) -> Iterator[LoggedAnswer]:
    """Yield answers of a zipped log, with one JSON file (deflate, zstd) per sample."""
    try:
        with reading_archive(), zipfile.ZipFile(path) as archive, path.open("rb") as raw:
            entries = [entry for entry in archive.infolist() if entry.filename.startswith("samples/")]
            if len(entries) > MAX_SAMPLES or sum(entry.file_size for entry in entries) > MAX_LOG_BYTES:
                raise TrapsError(f"{path}: has more than {MAX_SAMPLES} samples, or {MAX_LOG_BYTES} bytes of them")
            for entry in entries:
                if entry.file_size > MAX_SAMPLE_BYTES:
                    raise TrapsError(f"{path}: {entry.filename} has {entry.file_size} bytes; log without images")
                content = _unpack(raw, entry) if entry.compress_type == _ZSTD else archive.read(entry)
                yield _sample(f"{path}: {entry.filename}", json.loads(content))
    except OSError as error:
        raise TrapsError(f"{path}: cannot be read ({error.strerror or error})") from error
    except BadArchive as error:
        raise TrapsError(
            f"{path}: is no log that can be read ({plain(error)[:200]}); convert it: inspect log convert --to json"
        ) from error


def _unpack(raw: Any, entry: zipfile.ZipInfo) -> bytes:
    """Decompress a zstd entry, which zipfile lacks here. Raises ValueError."""
    import pyarrow as pa

    raw.seek(entry.header_offset)
    header = _LOCAL_HEADER.unpack(raw.read(_LOCAL_HEADER.size))
    raw.seek(header[-2] + header[-1], 1)  # the name and the extra field
    packed_bytes = raw.read(entry.compress_size)
    try:
        content = pa.decompress(packed_bytes, decompressed_size=entry.file_size, codec="zstd", asbytes=True)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(str(error)) from error
    if zlib.crc32(content) != entry.CRC:
        raise ValueError(f"{entry.filename} is damaged")
    return content


def _sample(where: str, sample: Any) -> LoggedAnswer:
    try:
        metadata, output = sample["metadata"], sample["output"]
        choices, epoch = output.get("choices") or [{}], sample.get("epoch", 1)
        stop = choices[0].get("stop_reason")
        outcome = OUTCOMES.get(ending_of(str(stop)), UNFINISHED)
        has_failed = bool(sample.get("error")) or not output.get("choices") or outcome == "error"
        answer = _answer(outcome, output.get("completion"))
        answer |= {"finish_reason": stop, "served_model": output.get("model") or None}
        answer |= {"reasoning": _reasoning(choices[0].get("message")), **_tokens(output.get("usage") or {})}
        if type(epoch) is not int:
            raise TypeError("its epoch is no whole number")
        return LoggedAnswer(where, str(metadata["item_id"]), str(metadata["regime"]), None, answer, epoch, has_failed)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise TrapsError(f"{where}: is no sample of this benchmark's task ({plain(repr(error))[:200]})") from error


def _reasoning(message: Any) -> str | None:
    """Return the text of a message's reasoning parts."""
    content = message.get("content") if isinstance(message, dict) else None
    parts = [part for part in content if isinstance(part, dict)] if isinstance(content, list) else []
    texts = [part.get("reasoning") for part in parts if part.get("type") == "reasoning" and not part.get("redacted")]
    return "\n\n".join(text for text in texts if isinstance(text, str)).strip() or None


def _tokens(usage: dict[str, Any]) -> dict[str, int | None]:
    """Return a call's tokens, None if unknown; the total tells whether cached and reasoning ones are counted within."""
    token_counts = {name: value for name, value in usage.items() if type(value) is int}
    cached_tokens = token_counts.get("input_tokens_cache_read", 0) + token_counts.get("input_tokens_cache_write", 0)
    counts: dict[str, Any] = {
        n: token_counts[n] for n in ("input_tokens", "output_tokens", "total_tokens") if n in token_counts
    }
    if token_counts.get("input_tokens", 0) + cached_tokens + token_counts.get("output_tokens", 0) <= token_counts.get(
        "total_tokens", 0
    ):
        counts["cache_read_input_tokens"] = cached_tokens
    counts["output_tokens_details"] = {"reasoning_tokens": usage.get("reasoning_tokens")}
    token_usage = read_usage(counts, Sizes(0, 0, 0))
    believed_usage = token_usage if token_usage and token_usage.believed else None
    return {
        "prompt_tokens": believed_usage and believed_usage.prompt,
        "completion_tokens": believed_usage and believed_usage.completion,
        "reasoning_tokens": believed_usage and believed_usage.reasoning,
    }


# --- lmms-eval and lines of one's own ---------------------------------------------------------------------------------


def _lmms_samples(path: Path) -> Iterator[LoggedAnswer]:
    for number, line in read_lines(path):
        location = f"{path}:{number}"
        try:
            row = json.loads(line)
            metadata, texts = row["traps_pecs"], row["filtered_resps"]
            while isinstance(texts, list):
                (texts,) = texts
            yield LoggedAnswer(
                location, str(metadata["item_id"]), str(metadata["regime"]), answer=_answer("answer", texts)
            )
        except (ValueError, KeyError, TypeError) as error:
            raise TrapsError(
                f"{location}: is no sample of this benchmark's tasks ({plain(repr(error))[:200]})"
            ) from error


def _plain_lines(path: Path) -> Iterator[LoggedAnswer]:
    """Yield lines with item, regime, text, and run if there are several."""
    for number, line in read_lines(path):
        try:
            row = json.loads(line)
            item, regime, run = row.pop("item"), row.pop("regime"), row.pop("run", None)
            if run is not None and type(run) is not int:
                raise ValueError("run is no whole number")
            answer = _answer(row.pop("outcome", "answer"), row.pop("text", None)) | row
            yield LoggedAnswer(f"{path}:{number}", str(item), str(regime), run, answer)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise TrapsError(f"{path}:{number}: gives no item, regime and text ({plain(repr(error))[:200]})") from error


def _answer(outcome: str, text: str | None) -> dict[str, Any]:
    """Return outcome and text for the ledger; a text only if the outcome has one."""
    if outcome in (*WITH_TEXT, UNFINISHED) and not (text or "").strip():
        outcome = "empty"
    return {"outcome": outcome, "text": text if outcome in (*WITH_TEXT, UNFINISHED) else None}
