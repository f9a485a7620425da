"""Verify a submission: recast votes, recompute numbers, compare with a release.

Votes are recast if that needs no key. Items, prompts and media are compared with the release's. The result names what
cannot be checked, among it every column of NOT_RECOMPUTED.
"""

import asyncio
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import pandas as pd

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.yamlfile import read_lines
from traps_pipeline.benchmark.items import commonest_answers, item_hash
from traps_pipeline.judging.judging_rows import VOTES
from traps_pipeline.judging.panel import parse_vote, tasks_for, vote_request
from traps_pipeline.judging.rules import RuleJudge
from traps_pipeline.judging.verdicts import verdicts_of
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.reading.interpret import degenerate, read_answer
from traps_pipeline.models.reading.judged_answers import is_correct
from traps_pipeline.models.registry.entries import is_reference
from traps_pipeline.models.registry.judges import RULE, RULES_VERSION, id_of_judges
from traps_pipeline.models.registry.prompts import prompt_version
from traps_pipeline.models.request import JUDGED_OUTCOMES, Outcome, Request
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS, TWO_EVENTS, dataset_of
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.protocol.two_events import lane_items
from traps_pipeline.release.submission import SUBMITTED_DATASETS, Submission, SubmittedJudge, read_submission
from traps_pipeline.scoring.score_rows import LEADERBOARD, METRICS, TWO_WAY
from traps_pipeline.scoring.scores import Scores, score
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.tables import Table, records

MAX_SENTENCES = 10  # sentences per kind; further ones are counted
CLOSE = 1e-9  # tolerance: linear algebra of another machine may differ in the last digits
_ITEM_COLUMNS = ("side", "pair_id", "dataset", "benchmark_version")  # columns that an answer has from its item
_OF_VOTE = ("side", "dataset", "benchmark_version")  # columns that a vote has from its item
# Columns that no number of a table gives; all others are compared with what the submission itself makes of them.
NOT_RECOMPUTED: Mapping[str, tuple[str, ...]] = {
    ITEMS.name: ("clip",),
    RESPONSES.name: (
        *("reasoning", "first_token", "finish_reason", "fragment", "error", "served_model", "client", "prompt_tokens"),
        *("completion_tokens", "reasoning_tokens", "cost_usd", "latency_s", "attempts", "request_key", "created_at"),
    ),
    VOTES.name: ("epoch", "created_at"),
}
# Of a language model's votes, besides; what it says of the value is compared with the value.
_SAID_BY_JUDGES = ("judge_correct", "confidence", "rationale")
Released = Mapping[str, tuple[str, str]]  # digests of item and clip by item
Row = Mapping[str, Any]


@dataclass
class Verification:
    """The checks of a submission or release, with their problems.

    problems: one sentence each; checked and unchecked: what was verified, and what could not be. verdicts and scored:
    recomputed from the votes, None if that is impossible.
    """

    problems: list[str] = field(default_factory=list)
    checked: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)
    verdicts: pd.DataFrame | None = None
    scored: Scores | None = None

    def record_check(self, topic: str, complaints: Iterator[str]) -> None:
        """Record a check of a submission and its problems; count those beyond the first few."""
        problems = list(complaints)
        self.checked.append(topic)
        self.problems += problems[:MAX_SENTENCES]
        if len(problems) > MAX_SENTENCES:
            self.problems.append(f"... and {len(problems) - MAX_SENTENCES} more of this kind")


def verify_file(path: Path, released: Released | None = None) -> tuple[Submission, Verification]:
    """Read and verify a submission. Raises TrapsError that names the file, whatever is in it."""
    try:
        submission = read_submission(path)
        return submission, verify(submission, released)
    except TrapsError:
        raise
    except Exception as error:
        reason = plain(f"{type(error).__name__}: {error}")[:200]
        raise TrapsError(f"{path}: holds what no check can read ({reason}); pack it again") from error


def verify(submission: Submission, released: Released | None = None) -> Verification:
    """Verify a submission, against `released_items` of a folder if given."""
    verification = Verification()
    items = {row["item_id"]: row for row in records(submission.read_table(ITEMS))}
    answers, votes = records(submission.read_table(RESPONSES)), records(submission.read_table(VOTES))
    verification.record_check("tables", (f"{file}: is not the table that was packed" for file in submission.altered))
    verification.record_check("items", _wrong_items(items.values()))
    verification.record_check("prompts", _wrong_prompts(submission))
    verification.record_check("answers", _wrong_answers(answers, items))
    verification.record_check("panel", _wrong_panel(submission, votes))
    is_judged_by_rules = all(seat.backend == RULE for seat in submission.about.judges)
    verification.record_check("votes", _wrong_votes(submission, votes, answers, items))
    _numbers(verification, submission)
    if released is None:
        verification.unchecked.append("items and clips against a release: name its folder with --release")
    else:
        verification.record_check("items and clips against the release", _foreign_items(items, released))
    verification.unchecked.append("that the answers are the model's: only who asked it knows")
    verification.unchecked.append("that the clips named by digest are those that the model was sent")
    columns = [f"{table} {', '.join(names)}" for table, names in NOT_RECOMPUTED.items()]
    if not is_judged_by_rules:
        verification.unchecked.append("that the judges cast these votes: asking language models again needs their keys")
        columns.append(f"votes of language models {', '.join(_SAID_BY_JUDGES)}")
    verification.unchecked.append(f"columns that no number is made of: {'; '.join(columns)}")
    return verification


# --- items and prompts ------------------------------------------------------------------------------------------------


def _wrong_items(items: Collection[Row]) -> Iterator[str]:
    answers = dict[tuple[str, str], str]()  # of each scenario, of two events of each lane
    for row in items:
        is_lane = row["dataset"] == TWO_EVENTS
        event = row["pair_id"].rpartition(".")[0] if is_lane else row["scenario_id"]
        answers[_kind(row), event] = row["control_answer"]
    commonest = commonest_answers([{"sub_scenario": key[0], "ground_truth": answers[key]} for key in sorted(answers)])
    for row in items:
        try:
            is_same = item_hash(row) == row["item_hash"]
        except (ValueError, RecursionError):
            is_same = False
        if not is_same or row["item_id"] not in _own_ids(row):
            yield f"item {row['item_id']}: is not what its digest says"
        elif row["dataset"] not in SUBMITTED_DATASETS:
            yield f"item {row['item_id']}: is none of the pairs' or of two events"
        elif row["commonest_answer"] != commonest[_kind(row)]:
            yield f"item {row['item_id']}: its commonest answer is not that of its sub-scenario"


def _kind(row: Row) -> str:
    """Return what an item's commonest answer is of: its sub-scenario, apart from that of two events."""
    return f"{row['dataset'] == TWO_EVENTS} {row['sub_scenario']}"


def _own_ids(row: Row) -> list[str]:
    """Return the ids that an item may have by its dataset, scenario and side, of two events also by its pair."""
    if row["dataset"] != TWO_EVENTS:
        return [f"{row['dataset']}:{row['scenario_id']}:{row['side']}"]
    names = row["side"], row["pair_id"]
    return [item.item_id for item in lane_items(row["scenario_id"]) if (item.side, item.pair_id) == names]


def _wrong_prompts(submission: Submission) -> Iterator[str]:
    for regime, version in submission.about.prompts.items():
        if regime not in REGIMES:
            yield f"regime {regime[:40]!r}: is unknown"
        elif version != prompt_version(regime):
            yield f"regime {regime}: was asked with another prompt than this version's"
    for regime in sorted({*submission.read_table(RESPONSES)["regime"]} - {*submission.about.prompts}):
        yield f"regime {str(regime)[:40]!r}: was asked with a prompt that is not named"


def released_items(release: Path) -> Released:
    """Return digests of item and clip by item. Raises TrapsError, also if altered."""
    from traps_pipeline.release.checksums import altered_files
    from traps_pipeline.release.content import CLIPS

    problems = altered_files(release)
    if problems:
        raise TrapsError(f"{release}: is not what was released: {problems[0]}")
    items = {}
    for number, line in read_lines(release / CLIPS / "metadata.jsonl"):
        row = json.loads(line)
        if "item_hash" not in row:
            raise TrapsError(f"{release}: is a held-out set; verify against the open release")
        items[row["item_id"]] = row["item_hash"], row["media_digest"]
        if row["dataset"] in SUBMITTED_DATASETS and item_hash(row) != row["item_hash"]:
            raise TrapsError(f"{release}: line {number} of its items is not what its digest says")
    return items


def _foreign_items(items: Mapping[str, Row], released_digests: Released) -> Iterator[str]:
    for id_, row in items.items():
        if id_ not in released_digests:
            yield f"item {id_}: is not in the release"
        elif released_digests[id_][1] != row["media_digest"]:
            yield f"item {id_}: its clip is not the released one"
        elif released_digests[id_][0] != row["item_hash"]:
            yield f"item {id_}: its question, choices or answer are not the released ones"
    datasets = {*DATASETS} | {dataset_of(id_) for id_ in items}
    missing_ids = sorted(id_ for id_ in released_digests if dataset_of(id_) in datasets and id_ not in items)
    for id_ in missing_ids:
        yield f"item {id_}: is in the release and was not asked"


# --- answers and votes ------------------------------------------------------------------------------------------------


def _row_name(row: Row) -> str:
    return f"{row['model']} ({row['regime']}, run {row['run']}) on {row['item_id']}"


def _wrong_answers(answers: Sequence[Row], items: Mapping[str, Row]) -> Iterator[str]:
    items_of = dict[tuple[Any, ...], set[str]]()
    for row in answers:
        item = items.get(row["item_id"])
        if item is None:
            yield f"answer of {_row_name(row)}: there is no such item"
            continue
        items_of.setdefault((row["dataset"], row["model"], row["regime"], row["run"]), set()).add(row["item_id"])
        if any(row[name] != item[name] for name in _ITEM_COLUMNS):
            yield f"answer of {_row_name(row)}: its pair, side, dataset or version is not its item's"
        text = row["text"] or ""
        if (row["outcome"] in JUDGED_OUTCOMES) != bool(text.strip()):
            yield f"answer of {_row_name(row)}: outcome {row['outcome']!r} does not go with its text"
        elif row["outcome"] in JUDGED_OUTCOMES and (reason := degenerate(text)):
            yield f"answer of {_row_name(row)}: {reason}, so it is none"
        elif row["outcome"] in JUDGED_OUTCOMES and row["is_json"] != read_answer(row, None, row["regime"]).is_json:
            yield f"answer of {_row_name(row)}: is_json is {row['is_json']}, which its text is not"
    expected = dict[str, set[str]]()
    for id_, item in items.items():
        expected.setdefault(item["dataset"], set()).add(id_)
    for (dataset, model, regime, run), ids in items_of.items():
        for id_ in sorted(expected.get(dataset, set()) - ids):
            yield f"answer of {model} ({regime}, run {run}) on {id_}: is missing"


def _wrong_panel(submission: Submission, votes: Sequence[Row]) -> Iterator[str]:
    description = submission.about
    own_id = id_of_judges(description.panel, description.judges)
    for panel in sorted({row["panel"] for row in votes} - {own_id}):
        yield f"panel {panel!r:.100}: these judges and this version's prompts are {own_id}"
    if {seat.backend for seat in description.judges} != {"api"} and not description.judged_by_rules:
        for model in sorted({row["model"] for row in votes}):
            if not is_reference(model):
                yield f"model {model!r:.100}: rules judged it, made for reference strategies, and nobody says so"
    for judge in sorted({row["judge"] for row in votes} - {seat.id for seat in description.judges}):
        yield f"judge {judge!r:.100}: sits in no panel of the submission"
    rules = [seat for seat in description.judges if seat.backend == RULE]
    if rules and any(seat.params != {"rules": RULES_VERSION} for seat in rules):
        yield f"panel {description.panel!r}: its rules are of another version than {RULES_VERSION}"


def _wrong_votes(
    submission: Submission, votes: Sequence[Row], answers: Sequence[Row], items: Mapping[str, Row]
) -> Iterator[str]:
    seats = {seat.id: seat for seat in submission.about.judges}
    key_of = itemgetter("item_id", "model", "regime", "run")
    texts = {key_of(row): row for row in answers if row["outcome"] in JUDGED_OUTCOMES}
    cast = dict[tuple[Any, ...], set[tuple[str, str]]]()
    for row in votes:
        key = key_of(row)
        answer, item, seat = texts.get(key), items.get(row["item_id"]), seats.get(row["judge"])
        if answer is None or item is None or seat is None or row["task"] not in tasks_for(item["side"]):
            yield f"vote of {row['judge']!r:.60} on {row['task']!r:.40} of {_row_name(row)}: there is nothing to judge"
            continue
        cast.setdefault(key, set()).add((row["task"], row["judge"]))
        if any(row[name] != item[name] for name in _OF_VOTE):
            name = f"vote of {row['judge']} on {row['task']} of {_row_name(row)}"
            yield f"{name}: its side, dataset or version is not its item's"
            continue
        cell = Cell(row["dataset"], Evaluation(row["model"], row["regime"], row["run"]))
        request = vote_request(seat, row["task"], cell, item, answer["text"])
        if request.key != row["vote_key"]:
            yield f"answer of {_row_name(row)}: is not the text, or not to the question, that {seat.id} judged"
            continue
        recast = _recast(str(row["task"]), request.user) if seat.backend == RULE else None
        problem = _vote_difference(row, item, seat, recast)
        if problem:
            yield f"vote of {seat.id} on {row['task']} of {_row_name(row)}: {problem}"
    for key, row in texts.items():
        item = items.get(row["item_id"])
        expected = {(task, judge) for task in tasks_for(item["side"]) for judge in seats} if item else set()
        for task, judge in sorted(expected - cast.get(key, set())):
            yield f"vote of {judge} on {task} of {_row_name(row)}: is missing"


@cache
def _recast(task: str, user: str) -> Outcome:
    """Return what the rules make of a request: they read its text and its task alone."""
    return asyncio.run(RuleJudge().ask(Request("rules", RULE, {}, "", user, {"task": task})))


def _vote_difference(row: Row, item: Row, seat: SubmittedJudge, again: Outcome | None) -> str:
    """Return how a vote differs from the correct one; wrong kinds decide nothing."""
    try:
        expected = _expected_of_rules(row, item, again) if again is not None else _expected_of_judge(row, item, seat)
    except (ValueError, TypeError, AttributeError) as error:
        return f"cannot be decided by its item ({error})"
    wrong_columns = [name for name, value in expected.items() if row[name] != value]
    decision = _decision_column(row)
    if again is None and row["valid"] and row[decision] is None:
        return "is valid and has no decision"
    maker = "its extracted value gives" if again is None and decision in wrong_columns else "its judge gives"
    return "".join(f"{n} is {row[n]!r:.40}, {maker} {expected[n]!r:.40}" for n in wrong_columns[:1])


def _decision_column(row: Row) -> str:
    return "abstained" if row["task"] == "abstention" else "correct"


def _expected_of_rules(row: Row, item: Row, again: Outcome) -> dict[str, Any]:
    """Return every column of a rule judge's vote that its answer decides."""
    vote = asdict(parse_vote(row["task"], {"outcome": again.kind, "text": again.text}, item))
    return {"abstained": None, "correct": None, _decision_column(row): vote.pop("decision")} | vote


def _expected_of_judge(row: Row, item: Row, seat: SubmittedJudge) -> dict[str, Any]:
    """Return the columns of a language model's vote that its other columns decide."""
    is_correctness = row["task"] == "correctness"
    if not row["valid"]:
        null = ["abstained", "correct", "judge_correct", "extracted_value", "confidence", "rationale"]
    else:
        null = [
            "invalid_reason",
            *(["abstained"] if is_correctness else ["correct", "judge_correct", "extracted_value"]),
        ]
    if not row["valid"] or is_correctness or not seat.premise:
        null.append("rejects_premise")
    expected: dict[str, Any] = dict.fromkeys(null)
    if row["valid"] and is_correctness:
        labels, aliases = list(item["labels"]), json.loads(item["aliases"])
        expected["correct"] = is_correct(
            row["extracted_value"], item["ground_truth"], item["answer_type"], labels, aliases
        )
    return expected


# --- numbers ----------------------------------------------------------------------------------------------------------


def _numbers(verified: Verification, submission: Submission) -> None:
    """Recompute verdicts, metrics and leaderboard; record differing numbers."""
    panel = id_of_judges(submission.about.panel, submission.about.judges)
    try:
        tables = (submission.read_table(table) for table in (ITEMS, RESPONSES, VOTES))
        items, answers, votes = tables
        columns = [c for c in items.columns if c not in answers.columns or c in ("item_id", "benchmark_version")]
        verdicts = verdicts_of(items.loc[:, columns], answers.drop(columns="benchmark_version"), votes).fillna(
            {"panel": panel}
        )
        verified.verdicts, verified.scored = verdicts, score(verdicts)
    except (TrapsError, ValueError, KeyError, TypeError) as error:
        verified.problems.append(f"no number can be computed: {error}")
        return
    verified.record_check("metrics", _number_differences(METRICS, submission, verified.scored.metrics))
    verified.record_check("leaderboard", _number_differences(LEADERBOARD, submission, verified.scored.board))
    if len(submission.read_table(TWO_WAY)) or len(verified.scored.two_way):
        verified.record_check("two events", _number_differences(TWO_WAY, submission, verified.scored.two_way))


def _number_differences(table: Table[Any], submission: Submission, recomputed: pd.DataFrame) -> Iterator[str]:
    key = list(table.key)
    frames = (submission.read_table(table), recomputed)
    stated_rows, own_rows = ({tuple(row[k] for k in key): row for row in records(frame)} for frame in frames)
    for entry in sorted({*stated_rows, *own_rows}, key=str):
        name = f"{table.name} {' '.join(map(str, entry))}"
        if entry not in own_rows or entry not in stated_rows:
            yield f"{name}: {'has no votes' if entry not in own_rows else 'is left out'}"
            continue
        for column in table.columns:
            stated_value, own_value = stated_rows[entry][column.name], own_rows[entry][column.name]
            if not _is_equal(stated_value, own_value):
                yield f"{name}: {column.name} is {stated_value!r:.40}, the votes give {own_value!r:.40}"


def _is_equal(first: Any, second: Any) -> bool:
    if isinstance(first, float) and isinstance(second, float):
        return math.isclose(first, second, rel_tol=CLOSE, abs_tol=CLOSE)
    return first == second
