"""Check models and judges with live calls before money is spent.

`traps models check --live` and the preflight of a run do. Each model is asked about a clip that is red and then blue,
once with the clip and once without, and in each other form of an answer that a run may ask for; each judge votes on
answers with known votes. Every problem is a sentence that names the cause and the remedy.
"""

import asyncio
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.redaction import redact
from traps_pipeline.base.terminal import plain
from traps_pipeline.checks.server_check import BAD_REQUEST, ServerCheck, check_server, nobody_at, wrong_key
from traps_pipeline.checks.wire_check import SyntheticClip, model_name, question
from traps_pipeline.judging.panel import parse_vote, vote_request
from traps_pipeline.models.asking.ask import Call, SettledCell, collect_outcomes
from traps_pipeline.models.asking.backends import make_backend
from traps_pipeline.models.asking.participants import Row
from traps_pipeline.models.money.budget import check_money
from traps_pipeline.models.money.forecast import remember_latencies
from traps_pipeline.models.reading.interpret import degenerate, read_answer
from traps_pipeline.models.reading.thinking import declaration_line, split_thinking, undeclared_mark
from traps_pipeline.models.registry.accounts import Account
from traps_pipeline.models.registry.entries import NETWORK, Entry, ModelEntry, account_of
from traps_pipeline.models.registry.judges import JudgeEntry, Task
from traps_pipeline.models.request import (
    MALFORMED,
    RATE_LIMITED,
    UNFINISHED,
    WITH_TEXT,
    Outcome,
    Request,
    TransientError,
)
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.storage.workspace import Workspace

CELL = Cell("occlusion", Evaluation("preflight", "standard", 1))  # a name in the ledger, not a model
TIMEOUT_S = 25.0  # of a call
COLOURS = {"red": (200, 30, 30), "blue": (30, 30, 200)}
QUESTION = "The whole picture has one colour and then another: which two colours does the clip show?"
_FPS, _SIZE, _FRAMES = 10, (120, 160), 50
_LATE = "timeout"  # the error of a call that may yet be answered
_NO_SCHEMA = "say `json_schema: false` and `waivers: {json_schema: WHY}`"
_NO_LOGPROBS = (
    "its answer has no log-probabilities, which the regime logprobs scores: say `params: {logprobs: true, "
    "top_logprobs: 20}`, or ask without that regime"
)
_JUDGED = (("I don't know.", True, False), ("The ball rolls down the ramp. The answer is: left.", False, True))
_ITEM: Mapping[str, Any] = {
    "item_id": "preflight",
    "question": "Does the ball roll left or right?",
    "ground_truth": "left",
    "answer_type": "direction",
    "labels": ["left", "right"],
    "aliases": "{}",
}


@dataclass(frozen=True)
class LiveResult:
    """An entry's result: problems, which make its answers worthless, and notes.

    unchecked: what no answer came in time for, so that nothing is known; empty if all that matters was checked.
    """

    entry: Entry
    problems: Sequence[str]
    notes: Sequence[str] = ()
    unchecked: str = ""

    @property
    def line(self) -> str:
        """The result as text, with one line per finding."""
        lines = [*(f"FAIL {problem}" for problem in self.problems), *(f"note {note}" for note in self.notes)]
        lines += [self.unchecked] if self.unchecked else []
        head = f"{'FAIL' if self.problems else 'not checked' if self.unchecked else 'ok  '} {self.entry.id}"
        return redact("\n".join([head, *(f"     {line}" for line in lines)]))


@cache
def _studio() -> SyntheticClip:
    halves = [np.full((*_SIZE, 3), colour, np.uint8) for colour in COLOURS.values()]
    return SyntheticClip([halves[2 * k // _FRAMES] for k in range(_FRAMES)], _FPS)


def requests_of(entry: Entry, forms: Collection[str] | None = None) -> dict[str, Request]:
    """Return an entry's new test calls by name.

    forms: see `Experiment.forms`; None stands for all that the entry declares.
    """
    now = datetime.now(UTC).isoformat()
    if isinstance(entry, JudgeEntry):
        tasks: tuple[Task, ...] = ("abstention", "correctness")
        requests = {
            f"{task} {k}": vote_request(entry, task, CELL, _ITEM, text)
            for task in tasks
            for k, (text, abstained, _) in enumerate(_JUDGED)
            if task == "abstention" or not abstained
        }
        return {name: replace(call, about={**call.about, "check": name, "at": now}) for name, call in requests.items()}
    assert isinstance(entry, ModelEntry)
    clip_media = _studio().prepare(entry.media) if entry.media else None
    calls = {"clip": ("standard", clip_media), "no clip": ("standard", None)}
    if entry.json_schema and (forms is None or "json" in forms):
        calls["schema"] = ("json", clip_media)
    if entry.params.get("logprobs") if forms is None else "logprobs" in forms:
        calls["logprobs"] = ("logprobs", clip_media)
    return {
        name: question(entry, regime, QUESTION, media, {"check": name, "at": now, "regime": regime})
        for name, (regime, media) in calls.items()
    }


# --- what is wrong ----------------------------------------------------------------------------------------------------


def findings(
    entry: Entry, account: Account, outcomes: Mapping[str, Outcome], reached: ServerCheck | None = None
) -> LiveResult:
    """Return an entry's problems and notes, from outcomes of `requests_of`."""
    problems, notes, server_check = list[str](), list[str](), reached or ServerCheck()
    # @VERSION may follow.
    answering_models = {(outcome.served_model or "").partition("@")[0] for outcome in outcomes.values()}
    if server_check.unlisted and model_name(entry) not in answering_models:
        return LiveResult(entry, [server_check.unlisted])
    if server_check.unlisted:
        notes.append(f"{server_check.unlisted}, and answers to that name: make sure that it is the model that you mean")
    if server_check.refused and all(outcome.error == f"http_{BAD_REQUEST}" for outcome in outcomes.values()):
        return LiveResult(entry, [server_check.refused])
    for name, outcome in outcomes.items():
        if name == "schema" and outcome.error is not None and outcome.error == outcomes["clip"].error:
            continue  # a failure without a schema, too, says nothing about schemas
        if outcome.kind == "error":
            sentence = _failure(entry, account, name, str(outcome.error))
            if outcome.error == RATE_LIMITED and any(response.kind in WITH_TEXT for response in outcomes.values()):
                notes.append(f"{name}: refused as one call too many; a run waits and asks again")
            else:
                (notes if outcome.error == _LATE else problems).append(sentence)
        elif outcome.kind == "malformed":
            form_error = None if outcome.error == MALFORMED else outcome.error
            problems.append(f"{name}: {form_error or 'its answer has no shape of its API; what it is stands above'}")
        elif outcome.kind == UNFINISHED:
            problems.append(f"{name}: it ends its answers for a reason that is not known ({outcome.finish_reason!r})")
        elif outcome.kind == "refused":
            reason = outcome.finish_reason or f"{outcome.error}; what it said stands above"
            problems.append(f"{name}: it refuses to answer ({reason})")
    if isinstance(entry, JudgeEntry):
        problems += _wrong_votes(entry, outcomes)
    elif isinstance(entry, ModelEntry):
        problems += [*_wrong_answers(entry, outcomes), *_clip_problems(entry, outcomes, notes)]
    if entry.prices is None:
        notes.append("its price is unknown: no budget bounds it, and a run needs --allow-unknown-prices")
    return LiveResult(entry, list(dict.fromkeys(problems)), notes, "" if problems else _unchecked(entry, outcomes))


def _unchecked(entry: Entry, outcomes: Mapping[str, Outcome]) -> str:
    """Return what is not known of an entry without the calls that were not answered in time; empty if all is."""
    late = {name for name, outcome in outcomes.items() if outcome.error in (_LATE, RATE_LIMITED)}
    needed = {"whether it sees the clip": {"clip"}}
    if isinstance(entry, JudgeEntry):
        tasks = {name.rpartition(" ")[0] for name in outcomes}
        needed = {f"its vote on {task}": {name for name in outcomes if name.startswith(task)} for task in tasks}
    elif "no clip" in late and not _names_colours(outcomes["clip"]):
        needed = {"whether it sees the clip": {"no clip"}}
    unknown = [subject for subject, names in needed.items() if names and names <= late]
    return f"not checked: {' and '.join(unknown)}, since no answer came in time" if unknown else ""


def _failure(entry: Entry, account: Account, name: str, error: str) -> str:
    location = account.base_url or entry.endpoint
    match error:
        case "unreachable" | "connection":
            return nobody_at(location)
        case "http_401" | "http_403":
            return wrong_key(account)
        case "http_403_denied":
            return f"{name}: {location} refuses the call (HTTP 403), and not for its key; what it said stands above"
        case "http_404":
            return f"{location} knows no model {model_name(entry)!r}, or has another path (is /v1 missing?)"
        case _ if error.startswith("ended_"):
            return f"{name}: its answer breaks off ({error.removeprefix('ended_')}), which the server's log explains"
        case "timeout":
            return f"{name}: no answer within {TIMEOUT_S:.0f} s; a model that thinks for long may need more"
        case "server_error" if name != "schema":
            return f"{name}: {location} ends in an error of its own; what it said stands above, and in the server's log"
        case "rate_limited":
            return f"{location} takes no call now; what it said stands above: wait, or raise the limit or quota there"
        case _ if name == "schema":
            return f"it refuses structured output ({error}): {_NO_SCHEMA}"
        case _:
            return (
                f"{name}: it refuses what the entry declares ({error}); what it said stands above. "
                "`params: {NAME: null}` leaves a parameter out, and a waiver says why"
            )


def _undeclared_thinking(entry: Entry, outcome: Outcome) -> str | None:
    """Return what to declare if an answer shows thinking between common marks."""
    mark = undeclared_mark(split_thinking(outcome.text or "", entry.thinking).answer)
    return f"it thinks between marks in its answer: say `{declaration_line(mark)}` in its entry" if mark else None


def _wrong_votes(entry: JudgeEntry, outcomes: Mapping[str, Outcome]) -> list[str]:
    messages = []
    for name, outcome in outcomes.items():
        if outcome.kind not in (*WITH_TEXT, "empty"):
            continue
        task: Task = "abstention" if name.startswith("abstention") else "correctness"
        _, abstained, correct = _JUDGED[int(name[-1])]
        vote = parse_vote(task, {"outcome": outcome.kind, "text": outcome.text}, _ITEM, entry.thinking)
        if not vote.valid:
            invalid = f"its vote on {task} does not meet the schema ({vote.invalid_reason})"
            messages.append(_undeclared_thinking(entry, outcome) or invalid)
        elif vote.decision is not (abstained if task == "abstention" else correct):
            messages.append(f"its vote on {task} of the plain answer {_JUDGED[int(name[-1])][0]!r} is wrong")
    return messages


def _wrong_answers(entry: ModelEntry, outcomes: Mapping[str, Outcome]) -> list[str]:
    messages = []
    for name, outcome in outcomes.items():
        text = outcome.text or ""
        if outcome.kind == "empty":
            messages.append(f"{name}: its answer is empty (finish reason {outcome.finish_reason})")
        if outcome.kind not in WITH_TEXT:
            continue
        if thinking_mark := _undeclared_thinking(entry, outcome):
            messages.append(thinking_mark)
            continue
        if name == "logprobs" and outcome.first_token is None:
            messages.append(_NO_LOGPROBS)
        row = {"outcome": outcome.kind, "text": text}
        reading = read_answer(row, None, "json" if name == "schema" else "standard", thinking=entry.thinking)
        if reading.outcome == "degenerate":
            messages.append(f"its answer is {plain(text)[:40]!r}, which {degenerate(text)}")
        elif reading.is_json is False and reading.outcome == "answer":
            messages.append(f"it ignores the schema (its answer in the JSON regime is no such object): {_NO_SCHEMA}")
    return messages


def _names_colours(outcome: Outcome) -> bool:
    return all(re.search(rf"\b{colour}\b", (outcome.text or "").lower()) for colour in COLOURS)


def _clip_problems(entry: ModelEntry, outcomes: Mapping[str, Outcome], notes: list[str]) -> list[str]:
    """Return whether the clip arrives, from the answer's colours or counted tokens."""
    clip, blank = outcomes.get("clip"), outcomes.get("no clip")
    if clip is None or blank is None or clip.kind not in WITH_TEXT:
        return []
    names_both_colours = _names_colours(clip)
    frame_count = None
    if clip.prompt_tokens is not None and blank.prompt_tokens is not None:
        frame_count = clip.prompt_tokens - blank.prompt_tokens
    if frame_count is not None and frame_count <= 0:
        return [
            f"it does not see the clip: {clip.prompt_tokens} prompt tokens with it and {blank.prompt_tokens} without; "
            f"is this a model that sees, and is `{entry.media.profile if entry.media else ''}` what its server takes?"
        ]
    if not names_both_colours and frame_count is None and blank.error not in (_LATE, RATE_LIMITED):
        return ["it does not see the clip: it names no colour of one that is red and then blue, nor counts its tokens"]
    if not names_both_colours and frame_count is not None:
        notes.append(f"it counts {frame_count} tokens for the clip, and does not name its colours (red, then blue)")
    return []


# --- asking -----------------------------------------------------------------------------------------------------------


def check_live(
    entries: Iterable[Entry], forms: Mapping[str, Collection[str] | None] = MappingProxyType({})
) -> list[LiveResult]:
    """Try models and judges with short calls in parallel, without a study; seconds are recorded, costs are not.

    forms: by an entry's id, see `requests_of`.
    """

    async def every() -> list[LiveResult]:
        return list(await asyncio.gather(*(one(entry) for entry in entries)))

    async def one(entry: Entry) -> LiveResult:
        account = account_of(entry)
        server_check = await asyncio.to_thread(check_server, entry, account)
        if server_check.problem:
            return LiveResult(entry, [server_check.problem])
        backend, began, seconds = make_backend(entry), time.monotonic(), list[float]()

        async def asked(request: Request) -> Outcome:
            try:
                async with asyncio.timeout(TIMEOUT_S):
                    outcome = await backend.ask(request)
                    seconds.append(time.monotonic() - began)
                    return outcome
            except TransientError as error:
                return replace(error.outcome, error=error.why if error.kind == MALFORMED else error.kind)
            except TimeoutError:
                seconds.append(TIMEOUT_S)  # at least
                return Outcome("error", error=_LATE)

        requests = requests_of(entry, forms.get(entry.id))
        outcomes = await asyncio.gather(*map(asked, requests.values()))
        if seconds:
            remember_latencies(entry, account.base_url, seconds)
        return findings(entry, account, dict(zip(requests, outcomes, strict=True)), server_check)

    return asyncio.run(every())


def preflight(
    workspace: Workspace, models: Sequence[Entry], judges: Sequence[Entry], forms: Collection[str]
) -> list[LiveResult]:
    """Check prices, then ask the models and judges of a run, under its budget; forms: see `requests_of`.

    The calls are in the ledger of votes. Raises TrapsError if the study does not allow a participant's cost: judges are
    checked before a model is asked.
    """
    entries = [entry for entry in (*models, *judges) if entry.backend == NETWORK]
    for entry in entries:
        check_money(workspace.study, entry)
    accounts = {entry.id: account_of(entry) for entry in entries}
    server_checks = {entry.id: check_server(entry, accounts[entry.id]) for entry in entries}
    quick_entries = {
        entry.id: entry.model_copy(
            update={"limits": entry.limits.model_copy(update={"retries": 1, "timeout_s": TIMEOUT_S / 2})}
        )
        for entry in entries
        if not server_checks[entry.id].problem
    }
    requests = {name: requests_of(entry, forms) for name, entry in quick_entries.items()}
    calls = [Call(request) for entry_requests in requests.values() for request in entry_requests.values()]
    outcomes: Mapping[str, Outcome] = {}
    if calls:

        def finish(settled: SettledCell[Cell, Call]) -> Mapping[str, Outcome]:
            return {key: _outcome(row) for key, row in settled.rows.items()}

        (outcomes,) = collect_outcomes(
            workspace, "preflight", workspace.votes, quick_entries.values(), [CELL], lambda _: calls, finish
        )
    problems = []
    for entry in entries:
        if problem := server_checks[entry.id].problem:
            problems.append(LiveResult(entry, [problem]))
        else:
            own_outcomes = {name: outcomes[request.key] for name, request in requests[entry.id].items()}
            problems.append(findings(entry, accounts[entry.id], own_outcomes, server_checks[entry.id]))
    return problems


def _outcome(row: Row) -> Outcome:
    names = ("text", "finish_reason", "error", "prompt_tokens", "served_model", "first_token")
    return Outcome(row["outcome"], **{name: row.get(name) for name in names})


def require_sound(results: Sequence[LiveResult], goes_on: Callable[[str], bool]) -> None:
    """Raise TrapsError naming every problem, or each unchecked entry unless `goes_on` accepts these."""
    messages = [f"{result.entry.id}: {problem}" for result in results for problem in result.problems]
    advice = "nothing was rendered and nothing was judged; --no-preflight runs all the same"
    if not messages:
        messages = [f"{result.entry.id}: {result.unchecked}" for result in results if result.unchecked]
        advice = "nothing was rendered and nothing was judged; --unchecked runs all the same"
        if messages and goes_on("\n".join(messages)):
            return
    if messages:
        raise TrapsError("\n".join([*messages, advice]))
