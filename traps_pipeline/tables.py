"""Every Parquet table's schema: columns, types, units. A table exists only with its schema here, checked on write.

Layout: `tables/<table>/<partition column>=<value>/.../part-0.parquet`. Partition columns are stored in the file too, so
that one file explains itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

# Columns of which two runs of the same study may differ; they take no part in data versions.
VOLATILE = ("created_at", "latency_s", "attempts")


@dataclass(frozen=True)
class Column:
    """One column. type is one of str, int, float, bool, time, strs (list of str); `?` in the type means nullable."""

    name: str
    type: str
    doc: str

    @property
    def nullable(self) -> bool:
        """Whether missing values are allowed."""
        return self.type.endswith("?")


@dataclass(frozen=True)
class Table:
    """A table's contract: what one row is, its columns, the columns that partition it, its key."""

    name: str
    row: str
    partition_by: tuple[str, ...]
    key: tuple[str, ...]
    columns: tuple[Column, ...]

    def arrow_schema(self) -> pa.Schema:
        """The schema that a written file has."""
        import pyarrow as pa

        types = {
            "str": pa.string(),
            "int": pa.int64(),
            "float": pa.float64(),
            "bool": pa.bool_(),
            "time": pa.timestamp("us", tz="UTC"),
            "strs": pa.list_(pa.string()),
        }
        return pa.schema(
            [
                pa.field(c.name, types[c.type.rstrip("?")], nullable=c.nullable, metadata={"doc": c.doc})
                for c in self.columns
            ]
        )


def _columns(text: str) -> tuple[Column, ...]:
    """`name type doc` a line."""
    rows = [line.split(None, 2) for line in text.splitlines() if line.strip()]
    return tuple(Column(name, kind, doc) for name, kind, doc in rows)


_CELL = """
    dataset str occlusion, occlusion_ill_posed, chaotic or chaotic_ill_posed
    model str id in assets/models.yaml
    regime str standard, guided or json
    run int independent repetition, from 1
"""
_VERSION = """
    benchmark_version str of the part of the benchmark that this row is from: release, or release+digest once corrected
"""

SCENE_SPECS = Table(
    "scene_specs",
    "a scenario",
    ("category",),
    ("scenario_id",),
    _columns(
        """
    scenario_id str family and number
    taxonomy str occlusion or chaotic
    category str one of twelve
    sub_scenario str the paper's name where it has one, else the family's
    family str module under scenes/families
    seed int number of the draw
    params str JSON: the family's parameters (SI units in the names)
    physics str JSON: solver settings, duration (s), frames a second
    camera str JSON: resolved free camera
    void_kind str occluder or truncation
    void str JSON: cover panel and first hidden frame, or cut frame
    question str well-posed question with its choices
    labels strs closed set of answers
    aliases str JSON: other wording to label
    answer_type str binary, direction, colour, count_range or numeric
    ground_truth str the label that the simulator's state gives
    ill_posed_question str question that the control clip cannot answer
    answerable_question str JSON: question, labels, answer that even the void shows
    scene_hash str digest of what the clips show
    spec_hash str digest of the whole record
    trajectory str path of the frozen qpos, relative to the checkout or the workspace if it lies there
    trajectory_sha256 str digest of its values
    twin str JSON: another world behind the same void: its parameters, answer, digest of its trajectory
    commit_s float time (s) from which the outcome holds
    margin_m float distance (m) of the end state from another outcome
    void_from_s float time (s) from which the void shows nothing decisive: hiding or cut
    evidence str JSON: all of the draw's evidence
"""
        + _VERSION
    ),
)

VIDEOS = Table(
    "videos",
    "a clip",
    ("category",),
    ("scenario_id", "side"),
    _columns(
        """
    scenario_id str family and number
    category str one of twelve
    side str control, void, or twin (the other world behind the same void, uncovered)
    path str mp4, relative to the workspace
    file_sha256 str digest of the file
    frames_sha256 str digest of the RGB frames before encoding
    n_frames int frames
    fps int frames a second
    width int pixels
    height int pixels
    duration_s float n_frames / fps
    size_bytes int size of the file
    scene_hash str digest of what the clip shows
"""
        + _VERSION
    ),
)

ITEMS = Table(
    "items",
    "a question put to a model about one clip",
    ("dataset",),
    ("item_id",),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    dataset str one of four
    scenario_id str family and number
    side str control or void
    taxonomy str occlusion or chaotic
    category str one of twelve
    sub_scenario str the paper's name where it has one
    question str with its choices
    labels strs closed set of answers
    aliases str JSON: other wording to label
    answer_type str binary, direction, colour, count_range or numeric
    ground_truth str? null on void
    control_answer str the pair's control answer: groups both sides by label; no model or judge sees it on a void
    commonest_answer str the commonest control answer of the sub-scenario: what `prior` says
    clip str mp4, relative to the workspace
    media_digest str digest of the clip's file
    item_hash str digest of everything above that decides an answer or its score
"""
        + _VERSION
    ),
)

RESPONSES = Table(
    "responses",
    "one answer of one model in one run",
    ("dataset", "model", "regime", "run"),
    ("item_id", "model", "regime", "run"),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    side str control or void
"""
        + _CELL
        + """
    outcome str answer, truncated, empty, refused or error
    text str? the visible answer; null unless outcome is answer or truncated
    reasoning str? the trace, where the provider returns it
    finish_reason str? as the provider said it
    error str? kind of a failure; never shown to a judge
    served_model str? what the provider says answered
    prompt_tokens int? tokens
    completion_tokens int? tokens
    reasoning_tokens int? tokens
    cost_usd float? dollars, with the worst case of attempts that may be billed; null where the price is unknown
    latency_s float seconds of the last attempt
    attempts int calls made for this row
    request_key str ledger key
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

VOTES = Table(
    "votes",
    "one judge on one task about one answer",
    ("dataset", "model", "regime", "run"),
    ("item_id", "model", "regime", "run", "task", "judge"),
    _columns(
        """
    item_id str dataset:scenario_id:side
    side str control or void
"""
        + _CELL
        + """
    task str abstention or correctness
    judge str id in assets/judges.yaml
    valid bool whether the judge's JSON meets the schema
    invalid_reason str? why not
    abstained bool? abstention task
    correct bool? correctness task, decided by code from extracted_value
    judge_correct bool? the judge's own claim, recorded and not used
    extracted_value str? correctness task
    confidence str? high, medium or low (abstention task)
    rationale str? one sentence
    vote_key str ledger key
    epoch str campaign in which it was asked
    created_at time when it was asked
"""
        + _VERSION
    ),
)

VERDICTS = Table(
    "verdicts",
    "the panel on one item",
    ("dataset", "model", "regime", "run"),
    ("item_id", "model", "regime", "run"),
    _columns(
        """
    item_id str dataset:scenario_id:side
    pair_id str dataset:scenario_id
    scenario_id str family and number
    side str control or void
    category str one of twelve
    sub_scenario str the paper's name where it has one
    control_answer str the pair's control answer
"""
        + _CELL
        + """
    outcome str of the response; only answer and truncated are judged
    abstained bool? majority; null if missing or undecided
    correct bool? majority on control; null on void, if missing or undecided
    n_valid int valid abstention votes
    n_valid_correctness int valid correctness votes (0 on void)
    unanimous bool all votes of all tasks valid and agreed
    undecided bool judged, but some task has no majority
    epoch str campaign in which it was asked
"""
        + _VERSION
    ),
)

METRICS = Table(
    "metrics",
    "a cell: one model, regime and run on one scope of a dataset",
    ("dataset",),
    ("dataset", "model", "regime", "run", "scope"),
    _columns(
        _CELL
        + """
    scope str all, category:.., sub_scenario:.. or label:.. (the control's answer)
    n_pairs int pairs in scope
    n_missing int items (of 2 n_pairs) without an answer or a majority
    n_refused int items refused
    n_empty int items answered with no text
    n_errors int items whose call failed
    n_answered int items answered with a text, whole or truncated
    acc float? share of decided controls answered correctly
    abs_rec float? share of decided voids abstained on
    false_abs float? share of decided controls abstained on
    j float? abs_rec - false_abs
    pecs float? acc x max(0, j)
    pecs_low float pecs if every missing decision were as bad for the model as can be, of all pairs
    pecs_high float pecs if every missing decision were as good for the model as can be, of all pairs
    naive float? acc x abs_rec
    epoch str campaigns of the answers, joined by +
"""
        + _VERSION
    ),
)

LEADERBOARD = Table(
    "leaderboard",
    "a model under a regime on one dataset, or overall (equal-weight mean over the four)",
    (),
    ("model", "regime", "dataset"),
    _columns(
        """
    model str id in assets/models.yaml
    regime str standard, guided or json
    dataset str one of four, or overall
    n_runs int runs averaged
    n_pairs int pairs a run
    n_missing int items without an answer or a majority, over runs
    n_refused int items refused, over runs
    n_empty int items answered with no text, over runs
    n_errors int items whose call failed, over runs
    answered float share of items (2 a pair and run) answered with a text, whole or truncated
    incomplete bool whether answered is below 0.99, on overall that of any of its datasets
    acc float? mean over runs
    acc_std float? population standard deviation over runs
    abs_rec float? mean over runs
    abs_rec_std float? population standard deviation over runs
    false_abs float? mean over runs
    false_abs_std float? population standard deviation over runs
    j float? mean over runs, not clipped
    j_std float? population standard deviation over runs
    pecs float? mean over runs of the per-run PECS
    pecs_std float? population standard deviation over runs
    pecs_ci_low float? 95 % percentile interval, cluster bootstrap over scenarios
    pecs_ci_high float? 95 % percentile interval, cluster bootstrap over scenarios
    pecs_low float mean over runs: pecs if every missing decision were as bad for the model as can be
    pecs_high float mean over runs: pecs if every missing decision were as good for the model as can be
    naive float? acc x abs_rec, mean over runs
    epoch str campaigns of the answers, joined by +
"""
        + _VERSION
    ),
)

TABLES = {t.name: t for t in (SCENE_SPECS, VIDEOS, ITEMS, RESPONSES, VOTES, VERDICTS, METRICS, LEADERBOARD)}
