"""Exchange answers with other systems, such as a cluster or a batch mode.

`export_requests` writes the missing requests as JSON lines, with their media by digest; `import_answers` reads answers
with the same keys and makes the same checks. Both files are data: nothing in them is executed or used unchecked.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from traps_pipeline.base import progress
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_file, write_bytes
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun
from traps_pipeline.base.yamlfile import faults_of, read_lines
from traps_pipeline.benchmark.held_out import opaque_name
from traps_pipeline.exchange.harness_logs import LOG, OUTCOMES, LoggedAnswer, log_reader
from traps_pipeline.exchange.provider_batch import export_batches, failures, is_batch, outcomes_of, read_batch
from traps_pipeline.judging.panel import wanted_ballots
from traps_pipeline.ledger.ledger import Ledger
from traps_pipeline.ledger.rows import MAX_TOKENS, Stored
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.asking.answers import prepare_media, wanted_questions
from traps_pipeline.models.asking.participants import ledger_row
from traps_pipeline.models.reading.endings import ending_of
from traps_pipeline.models.registry.entries import Entry, ModelEntry, account_of, get_model, load_models
from traps_pipeline.models.registry.judges import load_judges, load_panel
from traps_pipeline.models.request import UNFINISHED, WITH_TEXT, Outcome, OutcomeKind, Request
from traps_pipeline.pipeline.experiment import Experiment
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

REQUESTS, MEDIA = "requests.jsonl", "media"
# Beginnings of texts that a harness stores as the answer of a failed call.
_ERROR_TEXT = re.compile(  # own text: MAX_LOOKED_AT characters of one
    r"\W*(?:(?:\w+\.)*(?:\w*error|\w*exception)\b\s*(?:code)?\s*[:(\[\d-]|traceback \(most recent|an error occurred"
    r"|(?:\w+\.)+exceptions?\.\w+\b"
    r"|(?:http|status|code)\W*[45]\d\d\b|[45]\d\d (?:client|server) error|too many requests|rate limit"
    r"|internal server error|service unavailable"
    r"|bad gateway|gateway time-?out|(?:request|connection|read) (?:failed|error|refused|reset|timed out))",
    re.IGNORECASE,
)
MAX_LOOKED_AT = 200  # characters of a text
MAX_LINES = 5  # number of wrong lines that an error names


class Answer(BaseModel):
    """One line of a file of answers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
    key: str
    outcome: OutcomeKind = "answer"
    text: str | None = None
    reasoning: str | None = None
    finish_reason: str | None = None
    served_model: str | None = None
    prompt_tokens: int | None = Field(default=None, ge=0, le=MAX_TOKENS)
    completion_tokens: int | None = Field(default=None, ge=0, le=MAX_TOKENS)
    reasoning_tokens: int | None = Field(default=None, ge=0, le=MAX_TOKENS)
    latency_s: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _outcome_follows_the_reason(cls, data: Any) -> Any:
        """Take a missing outcome from the finish reason: half a sentence is no answer."""
        if isinstance(data, dict) and "outcome" not in data and isinstance(data.get("finish_reason"), str):
            return data | {"outcome": OUTCOMES.get(ending_of(data["finish_reason"]), UNFINISHED)}
        return data

    @model_validator(mode="after")
    def _text_goes_with_outcome(self) -> Answer:
        if self.outcome in ("error", "malformed"):
            raise ValueError("outcome: an error is no answer; remove the line, so that the item stays missing")
        has_text = self.outcome in (*WITH_TEXT, UNFINISHED)
        if has_text != bool((self.text or "").strip()):
            requirement = "needs a text" if has_text else "must have no text"
            raise ValueError(f"text: outcome {self.outcome!r} {requirement}")
        return self

    def as_outcome(self, entry: ModelEntry) -> Outcome:
        """Return the answer as an outcome, with its price from the registry."""
        fields = self.model_dump(exclude={"key", "outcome", "latency_s"})
        cost = None
        if entry.prices and self.prompt_tokens is not None and self.completion_tokens is not None:
            cost = entry.prices.cost(self.prompt_tokens, self.completion_tokens)
        return Outcome(self.outcome, **fields, cost_usd=cost)


@dataclass(frozen=True)
class ImportResult:
    """New answers, those already in the ledger, failed calls in words, and how many error messages were left out.

    scores: models, regimes and runs that the file answers, each of which has a score of its own.
    """

    new: int
    known: int
    failed: str = ""
    dropped: int = 0
    scores: int = 1


@dataclass(frozen=True)
class _Stored:
    """The outcome of a request, and its duration in seconds."""

    request: Request
    outcome: Outcome
    latency_s: float

    @property
    def evaluation(self) -> Evaluation:
        """The evaluation whose ledger holds it."""
        subject = self.request.about
        return Evaluation(str(subject["model"]), str(subject["regime"]), int(subject["run"]))


def export_requests(workspace: Workspace, experiment: Experiment, out: Path) -> int:
    """Write the experiment's missing requests to `out`; return their number.

    `out` gets requests.jsonl, and media/<sha256>.<suffix>. A line holds key, model, provider_id, params, system, user,
    about (item, model, regime, run) and media: profile, file, sha256, n_frames, times_s (s), fps. A local model's media
    is the clip itself: decode the frames at times_s. Raises TrapsError if items are missing or `out` already holds an
    export.
    """
    if (out / REQUESTS).exists():
        raise TrapsError(f"{out / REQUESTS} exists already; give another folder, or delete it")
    (out / MEDIA).mkdir(parents=True, exist_ok=True)
    prepare_media(workspace, _cells(workspace, experiment))
    count = 0
    with replace_file(out / REQUESTS) as part, part.open("w", encoding="utf-8") as stream:
        for request in _missing_requests(workspace, experiment):
            stream.write(json.dumps(_line(request, out), ensure_ascii=False) + "\n")
            count += 1
    return count


def _cells(workspace: Workspace, experiment: Experiment) -> list[Cell]:
    """Return the experiment's cells whose datasets have items, or raise TrapsError."""
    cells = [cell for cell in experiment.cells() if workspace.tables.state(ITEMS, {"dataset": cell.dataset})]
    if not cells:
        raise TrapsError(f"{workspace.root}: no items yet; materialize scene_specs, videos and items first")
    return cells


def _missing_requests(workspace: Workspace, experiment: Experiment) -> Iterator[Request]:
    settled_keys: dict[Evaluation, set[str]] = {}
    for cell in _cells(workspace, experiment):
        evaluation = cell.evaluation
        if evaluation not in settled_keys:
            settled_keys[evaluation] = {*workspace.answers.read(evaluation.key).settled}
        requests = (question.request for question in wanted_questions(workspace, cell))
        yield from (request for request in requests if request.key not in settled_keys[evaluation])


def _line(request: Request, out: Path) -> dict[str, Any]:
    media: dict[str, Any] | None = None
    if request.sent is not None and request.media is not None:
        source = request.sent.path or request.media
        file = out / MEDIA / f"{request.sent.sha256}{source.suffix}"
        if not file.exists():
            write_bytes(file, source.read_bytes())
        request_media = request.sent
        media = {"profile": request_media.profile, "file": f"{MEDIA}/{file.name}", "sha256": request_media.sha256}
        media |= {"n_frames": request_media.n_frames, "times_s": list(request_media.times_s), "fps": request_media.fps}
    return {
        "key": request.key,
        "model": request.participant,
        "provider_id": request.endpoint,
        "params": dict(request.params),
        "system": request.system,
        "user": request.user,
        "about": dict(request.about),
        "media": media,
    }


@dataclass(frozen=True)
class AnswerContext:
    """The context that a file of answers by item lacks.

    model: a model of the experiment (None: its only one); run; key: key of the held-out set whose opaque names the
    file has.
    """

    model: str | None = None
    run: int = 1
    key: bytes | None = None

    def name_of(self, request: Request) -> str:
        """Return an item's name as the file has it: a message about a held-out set may go to its participant."""
        item = str(request.about["item_id"])
        return opaque_name(self.key, item) if self.key else item


def import_answers(
    workspace: Workspace,
    experiment: Experiment,
    path: Path,
    context: AnswerContext | None = None,
    errors: Literal["drop", "keep"] | None = None,
) -> ImportResult:
    """Import answers into the ledger; `traps run` then builds tables from them.

    path: JSON lines, see `Answer`; or answers by item, see `exchange.harness_logs`. All lines are checked before any is
    written. Raises TrapsError naming lines that are not answers, that have a key outside the experiment (another
    question, clip, parameter or run), or that answer a key a second time differently; and for a file without answers.
    errors: whether texts that look like error messages are left out or are answers; if it is not given, TrapsError
    shows them.
    """
    cells = _cells(workspace, experiment)
    prepare_media(workspace, cells)
    requests = [question.request for cell in cells for question in wanted_questions(workspace, cell)]
    requests_by_key = {request.key: request for request in requests}
    if path.suffix != LOG and is_batch(path):
        return _import_batch(workspace, workspace.answers, load_models(), requests_by_key, path)
    reader, context = log_reader(path), context or AnswerContext()
    answers, n_failed = (
        (checked_answers(path, requests_by_key), 0)
        if reader is None
        else _answers_by_item(reader(path), requests_by_key, context)
    )
    if not answers:
        raise TrapsError(f"{path}: holds no answers; nothing was imported")
    like_errors = [key for key, answer in answers.items() if _ERROR_TEXT.match((answer.text or "")[:MAX_LOOKED_AT])]
    if like_errors and errors is None:
        texts = [(context.name_of(requests_by_key[key]), plain(answers[key].text)[:60]) for key in like_errors]
        raise TrapsError(
            f"{path}: {count_noun(len(texts), 'text')} may be an error message, not an answer "
            f"({'; '.join(f'{item}: {text!r}' for item, text in texts[:MAX_LINES])}): say --errors drop to leave them "
            "missing, or --errors keep if they are answers; nothing was imported"
        )
    for key in like_errors if errors == "drop" else ():
        del answers[key]
    outcomes = [
        _Stored(requests_by_key[key], answer.as_outcome(get_model(requests_by_key[key].participant)), answer.latency_s)
        for key, answer in answers.items()
    ]
    new = asyncio.run(_store(workspace, workspace.answers, outcomes))
    failed = f"{count_noun(n_failed, 'sample')} of the log" if n_failed else ""
    dropped, scores = len(like_errors) if errors == "drop" else 0, len({stored.evaluation for stored in outcomes})
    return ImportResult(new, len(answers) - new, failed, dropped, scores)


def export_request_batches(
    workspace: Workspace, experiment: Experiment, out: Path, media_at: str | None = None
) -> tuple[list[Path], int]:
    """Write missing requests as batches (`export_batches`); return files and calls."""
    prepare_media(workspace, _cells(workspace, experiment))
    missing: dict[str, list[Request]] = {}
    for request in _missing_requests(workspace, experiment):
        missing.setdefault(request.participant, []).append(request)
    return export_batches({name: (get_model(name), requests) for name, requests in missing.items()}, out, media_at)


def export_vote_batches(workspace: Workspace, experiment: Experiment, out: Path) -> tuple[list[Path], int]:
    """Write missing votes as batch files; return these and the number of calls. Raises TrapsError without answers."""
    missing: dict[str, list[Request]] = {}
    settled_keys: dict[Evaluation, set[str]] = {}
    for cell, request in _wanted_votes(workspace, experiment):
        if cell.evaluation not in settled_keys:
            settled_keys[cell.evaluation] = {*workspace.votes.read(cell.evaluation.key).settled}
        if request.key not in settled_keys[cell.evaluation]:
            missing.setdefault(request.participant, []).append(request)
    judges = load_judges()
    return export_batches({name: (judges[name], requests) for name, requests in missing.items()}, out)


def import_votes(workspace: Workspace, experiment: Experiment, path: Path) -> ImportResult:
    """Import votes into their ledger. Raises TrapsError as `import_answers` does."""
    requests_by_key = {request.key: request for _, request in _wanted_votes(workspace, experiment)}
    return _import_batch(workspace, workspace.votes, load_judges(), requests_by_key, path)


def _wanted_votes(workspace: Workspace, experiment: Experiment) -> Iterator[tuple[Cell, Request]]:
    panel = load_panel(workspace.study.panel)
    cells = [cell for cell in _cells(workspace, experiment) if workspace.tables.state(RESPONSES, cell.partition)]
    if not cells:
        raise TrapsError(f"{workspace.root}: no answers yet; make responses first (traps run ... --until responses)")
    for cell in cells:
        yield from ((cell, ballot.request) for ballot in wanted_ballots(workspace, panel, cell))


def _apply_batch_price(entry: Entry, outcome: Outcome) -> Outcome:
    outcome = replace(outcome, client=None)  # the client is unknown: another version may have exported the call
    if outcome.cost_usd is None:
        return outcome
    return replace(outcome, cost_usd=outcome.cost_usd * account_of(entry).batch_price)


def _import_batch(
    workspace: Workspace, ledger: Ledger, entries: Mapping[str, Entry], requested: Mapping[str, Request], path: Path
) -> ImportResult:
    results = read_batch(path, requested)
    if not results:
        raise TrapsError(f"{path}: holds no answers; nothing was imported")
    outcomes = [
        _Stored(request, _apply_batch_price(entries[request.participant], outcome), 0.0)
        for request, outcome in outcomes_of(entries, requested, results)
    ]
    new = asyncio.run(_store(workspace, ledger, outcomes))
    failed = sum(answer.outcome.kind in ("error", "malformed") for answer in outcomes)
    return ImportResult(new, len(outcomes) - new - failed, failures([answer.outcome for answer in outcomes]))


def checked_answers(path: Path, requested: Mapping[str, Request]) -> dict[str, Answer]:
    """Return a file's answers by key. Raises TrapsError naming up to five bad lines."""
    answers: dict[str, Answer] = {}
    problems: list[str] = []
    for number, line in read_lines(path):
        try:
            answer = Answer.model_validate(json.loads(line))
        except ValidationError as error:
            problems.append(f"{path}:{number}: {faults_of(error, Answer)}")
            continue
        except (ValueError, RecursionError) as error:
            problems.append(f"{path}:{number}: not JSON ({plain(error)[:200]})")
            continue
        if answer.key not in requested:
            problems.append(f"{path}:{number}: key {answer.key[:16]} is not wanted: question, clip or setting changed")
        elif answers.setdefault(answer.key, answer) != answer:
            problems.append(f"{path}:{number}: gives another answer to the key of an earlier line")
    if problems:
        suffix = f"\n... and {len(problems) - MAX_LINES} more" if len(problems) > MAX_LINES else ""
        raise TrapsError("\n".join(problems[:MAX_LINES]) + suffix + "\nnothing was imported")
    return answers


def _answers_by_item(
    imported: Iterable[LoggedAnswer], requested: Mapping[str, Request], context: AnswerContext
) -> tuple[dict[str, Answer], int]:
    """Return a harness's answers by key, and how many calls have none. Raises TrapsError for unwanted ones."""
    models = sorted({request.participant for request in requested.values()})
    model = context.model or (models[0] if len(models) == 1 else None)
    if model not in models:
        raise TrapsError(f"say whose answers these are: --model, one of {', '.join(models)}")
    keys = {
        (str(subject["item_id"]), str(subject["regime"]), int(subject["run"])): key
        for key, request in requested.items()
        if (subject := request.about)["model"] == model
    }
    names = {opaque_name(context.key, item): item for item, _, _ in keys} if context.key else {}
    answers, problems, failed = dict[str, Answer](), list[str](), set[str]()
    for log_answer in imported:
        run = context.run + log_answer.epoch - 1 if log_answer.run is None else log_answer.run
        key = keys.get((names.get(log_answer.item, "" if context.key else log_answer.item), log_answer.regime, run))
        try:
            if key is None:
                problems.append(
                    f"{log_answer.where}: {log_answer.item} under {log_answer.regime}, run {run}, "
                    f"is not wanted of {model}"
                )
            elif log_answer.has_failed:
                failed.add(key)
            elif answers.setdefault(key, answer := Answer(key=key, **log_answer.answer)) != answer:
                problems.append(f"{log_answer.where}: gives another answer to {log_answer.item} than an earlier one")
        except ValidationError as error:
            problems.append(f"{log_answer.where}: {faults_of(error)}")
        except TypeError as error:
            problems.append(f"{log_answer.where}: {plain(error)[:200]}")
    if problems:
        suffix = f"\n... and {len(problems) - MAX_LINES} more" if len(problems) > MAX_LINES else ""
        raise TrapsError("\n".join(map(plain, problems[:MAX_LINES])) + suffix + "\nnothing was imported")
    return answers, len(failed - answers.keys())


async def _store(workspace: Workspace, ledger: Ledger, stored: Sequence[_Stored]) -> int:
    """Store outcomes that the ledger lacks, all or none; return how many are answers."""
    rows: dict[str, list[Stored]] = {}
    for answer in sorted(stored, key=lambda answer: answer.evaluation):
        row = ledger_row(answer.request, answer.outcome, 1, answer.latency_s, workspace.study.epoch)
        rows.setdefault(answer.evaluation.key, []).append(row)
    return await ledger.store(rows, progress.current().note)
