"""Export calls as providers' batch files, and import answers (docs/models.md).

A body is exactly the live call's: the entry's backend sends it to this machine, where it is recorded. An answer is read
exactly like the live call's: the backend gets it from this machine, with the provider's status. So both ways produce
the same rows.
"""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_file
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.yamlfile import read_lines
from traps_pipeline.checks.loopback import replay, sent_bodies
from traps_pipeline.checks.wire_body import Api, WireBody
from traps_pipeline.exchange.media_references import FOLDER as MEDIA
from traps_pipeline.exchange.media_references import MediaReferences
from traps_pipeline.models.registry.entries import Entry
from traps_pipeline.models.request import Outcome, Request

FOLDER = "batches"
AT_ONCE = 200  # maximum bodies in memory
# Providers' published limits of calls and bytes per file; vLLM's run-batch reads OpenAI's form.
LIMITS: Mapping[Api, tuple[int, int]] = {
    "chat": (50_000, 190 * 2**20),
    "responses": (50_000, 190 * 2**20),
    "gemini": (50_000, 1900 * 2**20),
    "anthropic": (100_000, 240 * 2**20),
}
MAX_LINES = 5
FAILED = 400  # lowest status of a failure


Item = TypeVar("Item")


def _chunks(items: Iterable[Item]) -> Iterator[list[Item]]:
    """Yield the items in lists of at most AT_ONCE."""
    iterator = iter(items)
    while chunk := list(islice(iterator, AT_ONCE)):
        yield chunk


# --- export -----------------------------------------------------------------------------------------------------------


def export_batches(
    calls: Mapping[str, tuple[Entry, Iterable[Request]]], out: Path, media_at: str | None = None
) -> tuple[list[Path], int]:
    """Write participants' calls as files below `out`, split at the providers' limits.

    Return the files and the number of calls. media_at: the future address of the folder `media` of `out`, which the
    bodies then refer to; without it media are inline. Raises TrapsError if a call cannot be built, or if files exist
    already.
    """
    if local_names := [name for name, (entry, _) in calls.items() if entry.account is None]:
        verb = " and others are" if len(local_names) > 5 else " are" if len(local_names) > 1 else " is"
        raise TrapsError(
            f"{', '.join(local_names[:5])}{verb} asked here, "
            "and only a provider takes batches: leave --batch out, or take experiment and panel of others"
        )
    folder = out / FOLDER
    if folder.exists() and any(folder.iterdir()):
        raise TrapsError(f"{folder} holds batches already; give another folder, or delete it")
    folder.mkdir(parents=True, exist_ok=True)
    files, count = list[Path](), 0
    references = MediaReferences(out / MEDIA, media_at) if media_at else None
    for name, (entry, requests) in calls.items():
        part = _Part(folder, name)
        for chunk in _chunks(requests):
            for request, wire in zip(chunk, sent_bodies(entry, chunk), strict=True):
                if isinstance(wire, str) or wire.api is None:
                    raise TrapsError(
                        f"{name}: no batch can be made of its calls: {wire if isinstance(wire, str) else wire.path}"
                    )
                body = references.instead_of(wire.body) if references else wire.body
                part.add(wire.api, line_of(request.key, wire, body))
                count += 1
        files += part.written()
    return files, count


def line_of(key: str, wire: WireBody, body: Mapping[str, Any]) -> dict[str, Any]:
    """Return the line of a call with this body, in its provider's form."""
    match wire.api:
        case "gemini":
            return {"key": key, "request": body}
        case "anthropic":
            return {"custom_id": key, "params": body}
        case _:
            return {
                "custom_id": key,
                "method": "POST",
                "url": "/v1/" + wire.path.split("/v1/", 1)[-1].lstrip("/"),
                "body": body,
            }


@dataclass
class _Part:
    """The files of one participant, each below its provider's limits."""

    folder: Path
    name: str
    files: list[Path] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    size: int = 0
    api: Api = "chat"

    def add(self, api: Api, line: Mapping[str, Any]) -> None:
        text = json.dumps(line, ensure_ascii=False)
        max_calls, most_bytes = LIMITS[api]
        if self.lines and (len(self.lines) >= max_calls or self.size + len(text.encode()) > most_bytes):
            self._close()
        self.api = api
        self.lines.append(text)
        self.size += len(text.encode()) + 1

    def _close(self) -> None:
        suffix = "json" if self.api == "anthropic" else "jsonl"
        path = self.folder / f"{self.name}-{len(self.files) + 1}.{suffix}"
        text = "\n".join(self.lines) + "\n"
        if self.api == "anthropic":  # its API takes one object
            text = '{"requests": [' + ",\n".join(self.lines) + "]}\n"
        with replace_file(path) as part:
            part.write_text(text, encoding="utf-8")
        self.files.append(path)
        self.lines, self.size = [], 0

    def written(self) -> list[Path]:
        if self.lines:
            self._close()
        return self.files


# --- import -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BatchResult:
    """A call's status and body, or in one word the reason why they are absent."""

    status: int = 0
    body: bytes = b""
    error: str = ""


def is_batch(path: Path) -> bool:
    """Return whether a file is a provider's batch, not answers in this project's form."""
    for _, line in read_lines(path):
        try:
            line_value = json.loads(line)
        except (ValueError, RecursionError):
            return False
        return isinstance(line_value, dict) and (
            "custom_id" in line_value or bool({"response", "error"} & {*line_value})
        )
    return False


def read_batch(path: Path, wanted: Mapping[str, Request]) -> dict[str, BatchResult]:
    """Return a provider's results by key. Raises TrapsError naming wrong, unwanted and repeated lines."""
    answers, problems = dict[str, BatchResult](), list[str]()
    for number, line in read_lines(path):
        try:
            key, result = _read_result(json.loads(line))
        except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
            problems.append(
                f"{path}:{number}: no line of a batch that is known ({type(error).__name__}: {plain(error)[:100]})"
            )
            continue
        if key not in wanted:
            problems.append(f"{path}:{number}: key {plain(key)[:16]} is not wanted: question, clip or setting changed")
        elif answers.setdefault(key, result) != result:
            problems.append(f"{path}:{number}: gives another answer to the key of an earlier line")
    if problems:
        suffix = f"\n... and {len(problems) - MAX_LINES} more" if len(problems) > MAX_LINES else ""
        raise TrapsError("\n".join(problems[:MAX_LINES]) + suffix + "\nnothing was imported")
    return answers


def _read_result(line: Any) -> tuple[str, BatchResult]:
    if "result" in line:  # Anthropic
        result = line["result"]
        if result["type"] == "succeeded":
            return line["custom_id"], BatchResult(200, json.dumps(result["message"]).encode())
        return line["custom_id"], BatchResult(error=_word(result["type"]))
    key = line["custom_id"] if "custom_id" in line else line["key"]
    error, response = line.get("error"), line.get("response")
    status = int((response or {}).get("status_code") or 0)
    if error and status >= FAILED:  # vLLM: a status without a body, and beside it what it would have been
        return key, BatchResult(status, json.dumps({"error": error.get("error") or error}).encode())
    if error:
        return key, BatchResult(error=_word(error.get("code") or error.get("status") or "error"))
    if "custom_id" in line:  # OpenAI, vLLM
        return key, BatchResult(status, json.dumps(response["body"]).encode())
    return key, BatchResult(200, json.dumps(response).encode())  # Gemini


def _word(value: Any) -> str:
    """Return the kind of a batch failure, as the provider names it."""
    return "batch_" + "".join(c for c in str(value).lower() if c.isalnum() or c == "_").removeprefix("batch_")[:40]


def outcomes_of(
    entries: Mapping[str, Entry], wanted: Mapping[str, Request], returned: Mapping[str, BatchResult]
) -> Iterator[tuple[Request, Outcome]]:
    """Yield each returned call with its outcome, read like a live call's."""
    keys_by_name: dict[str, list[str]] = {}
    for key in returned:
        keys_by_name.setdefault(wanted[key].participant, []).append(key)
    for name, keys in keys_by_name.items():
        for chunk in _chunks([key for key in keys if not returned[key].error]):
            answers = [(returned[key].status, returned[key].body) for key in chunk]
            yield from zip(
                (wanted[key] for key in chunk),
                replay(entries[name], [wanted[key] for key in chunk], answers),
                strict=True,
            )
        for key in keys:
            if returned[key].error:
                yield wanted[key], Outcome("error", error=returned[key].error, cost_usd=0.0)


def failures(outcomes: Sequence[Outcome]) -> str:
    """Return the numbers of failed calls by kind, in words; empty if none failed."""
    kinds = Counter(outcome.error for outcome in outcomes if outcome.kind in ("error", "malformed"))
    return ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items(), key=str))
