"""Define the tables scenarios, clips and items, and select their current rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.tables import Table

if TYPE_CHECKING:
    import pandas as pd

    from traps_pipeline.storage.workspace import Workspace

Taxonomy = Annotated[str, "occlusion or chaotic"]
Labels = Annotated[list[str], "closed set of answers"]
Aliases = Annotated[str, "JSON: other wording to label"]
AnswerType = Annotated[str, "binary, direction, colour, count_range or numeric"]


@dataclass(frozen=True, kw_only=True)
class SceneSpecRow:
    """A scenario: parameters, question, answer and evidence, as its record has them."""

    scenario_id: shared.ScenarioId
    taxonomy: Taxonomy
    category: shared.Category
    sub_scenario: Annotated[str, "the paper's name where it has one, else the family's"]
    family: Annotated[str, "module under scenes/families; recorded: nothing was simulated"]
    seed: Annotated[int, "number of the draw"]
    params: Annotated[str, "JSON: the family's parameters (SI units in the names)"]
    physics: Annotated[str, "JSON: solver settings, duration (s), frames a second"]
    camera: Annotated[str, "JSON: resolved free camera"]
    void_kind: Annotated[str, "occluder or truncation"]
    void: Annotated[str, "JSON: occluder and first hidden frame, or cut frame"]
    control: Annotated[
        str, "JSON: frame from which an occluder closes the control, of a chaotic one with the occluder; or null"
    ]
    question: Annotated[str, "well-posed question with its choices"]
    labels: Labels
    aliases: Aliases
    answer_type: AnswerType
    ground_truth: Annotated[str, "the label that the simulator's state gives"]
    ill_posed_question: Annotated[str, "question that the control clip cannot answer"]
    answerable_question: Annotated[str, "JSON: question, labels, answer that even the void shows; null if recorded"]
    scene_hash: Annotated[str, "digest of what the clips show"]
    spec_hash: Annotated[str, "digest of the whole record"]
    trajectory: Annotated[str, "path of the frozen qpos (or recorded clip), relative to the checkout or workspace"]
    trajectory_sha256: Annotated[str, "digest of its values"]
    twin: Annotated[str, "JSON: another world behind the same void: its parameters, answer, digest of its trajectory"]
    commit_s: Annotated[float, "time (s) from which the outcome holds; the clip's end if recorded: nobody measured it"]
    margin_m: Annotated[float, "distance (m) of the end state from another outcome; 0 if recorded"]
    void_from_s: Annotated[float, "time (s) from which the void shows nothing decisive: hiding or cut"]
    evidence: Annotated[str, "JSON: all of the draw's evidence"]
    benchmark_version: shared.BenchmarkVersion


SCENE_SPECS = Table("scene_specs", SceneSpecRow, partition_by=("category",), key=("scenario_id",))


@dataclass(frozen=True, kw_only=True)
class VideoRow:
    """A clip of one side of a scenario, and how it was encoded."""

    scenario_id: shared.ScenarioId
    category: shared.Category
    side: Annotated[str, "control, void, or twin (the other world behind the same void, uncovered)"]
    path: shared.ClipPath
    file_sha256: Annotated[str, "digest of the file"]
    frames_sha256: Annotated[str, "digest of the RGB frames before encoding"]
    n_frames: Annotated[int, "frames"]
    fps: Annotated[int, "frames a second"]
    width: Annotated[int, "pixels"]
    height: Annotated[int, "pixels"]
    duration_s: Annotated[float, "n_frames / fps"]
    size_bytes: Annotated[int, "size of the file"]
    scene_hash: Annotated[str, "digest of what the clip shows"]
    benchmark_version: shared.BenchmarkVersion


VIDEOS = Table("videos", VideoRow, partition_by=("category",), key=("scenario_id", "side"))


@dataclass(frozen=True, kw_only=True)
class ArmRow:
    """An arm's or variation's clip and question, or why a scenario has none."""

    scenario_id: shared.ScenarioId
    category: shared.Category
    arm: Annotated[str, "name of the arm or variation, which is its dataset"]
    item: Annotated[str, "last part of the item's id: the side, of two events the asked lane and the clip"]
    side: Annotated[str, "control: must be answered; void: must be abstained on"]
    question: shared.Question
    labels: Labels
    ground_truth: Annotated[str | None, "null on void"]
    refused: Annotated[str | None, "why the scenario does not admit the arm; null where it does"]
    evidence: Annotated[str, "JSON: the numbers behind the arm's certificate"]
    clip: Annotated[str | None, "path of the mp4, relative to the workspace; the pair's own where words alone differ"]
    media_digest: Annotated[str | None, "digest of the clip's file"]
    n_frames: Annotated[int | None, "frames"]
    duration_s: Annotated[float | None, "seconds"]
    scene_hash: Annotated[str, "digest of what the pair shows"]
    benchmark_version: shared.BenchmarkVersion


ARMS = Table("arms", ArmRow, partition_by=("category",), key=("scenario_id", "arm", "item"))


@dataclass(frozen=True, kw_only=True)
class ItemRow:
    """A question put to a model about one clip."""

    item_id: shared.ItemId
    pair_id: shared.PairId
    dataset: shared.Dataset
    scenario_id: shared.ScenarioId
    side: shared.Side
    taxonomy: Taxonomy
    category: shared.Category
    sub_scenario: shared.SubScenario
    question: shared.Question
    labels: Labels
    aliases: Aliases
    answer_type: AnswerType
    ground_truth: Annotated[str | None, "null on void"]
    control_answer: Annotated[
        str, "the pair's control answer: groups both sides by label; no model or judge sees it on a void"
    ]
    commonest_answer: Annotated[str, "the commonest control answer of the sub-scenario: what `prior` says"]
    clip: shared.ClipPath
    media_digest: shared.MediaDigest
    item_hash: Annotated[str, "digest of everything above that decides an answer or its score"]
    benchmark_version: shared.BenchmarkVersion


ITEMS = Table("items", ItemRow, partition_by=("dataset",), key=("item_id",))


def current_rows(
    workspace: "Workspace", table: Table, columns: Sequence[str] | None = None, dataset: str | Sequence[str] = DATASETS
) -> "pd.DataFrame":
    """Return a table's rows whose items are still in the benchmark.

    Every count uses these: a cell that was evaluated before a correction may hold others. Rows of arms come only if
    `dataset` names them.
    """
    rows = workspace.tables.read_all(table, columns, dataset=dataset)
    current_ids = workspace.tables.read_all(ITEMS, ["item_id"])["item_id"]
    return rows.loc[rows["item_id"].isin(current_ids)].reset_index(drop=True)
