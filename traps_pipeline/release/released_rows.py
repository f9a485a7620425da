"""Define a release's tables, the source of dictionary, card and Croissant file."""

from dataclasses import dataclass
from typing import Annotated

from traps_pipeline.scoring.score_rows import LeaderboardRow
from traps_pipeline.storage import columns as shared
from traps_pipeline.storage.benchmark_tables import AnswerType, ItemRow, Labels, SceneSpecRow, Taxonomy
from traps_pipeline.storage.tables import Table

Canary = Annotated[str, "the benchmark's canary: a text that must never be trained on holds it"]
Lite = Annotated[bool, "whether the scenario is one of the lite set"]


@dataclass(frozen=True, kw_only=True)
class PairRow:
    """A pair: one control and one void of a scenario, which differ by one change."""

    pair_id: shared.PairId
    dataset: Annotated[str, "occlusion, chaotic, or one of them with _ill_posed"]
    scenario_id: shared.ScenarioId
    taxonomy: Taxonomy
    category: shared.Category
    sub_scenario: shared.SubScenario
    control_item_id: shared.ItemId
    void_item_id: shared.ItemId
    control_file_name: Annotated[str, "mp4 that shows the outcome, relative to the folder"]
    void_file_name: Annotated[str, "mp4 of the void, relative to the folder; of an ill-posed pair the control's"]
    control_question: shared.Question
    void_question: Annotated[str, "the same question, or the one that no clip answers"]
    labels: Labels
    aliases: Annotated[str, "JSON: other wording to label"]
    answer_type: AnswerType
    ground_truth: Annotated[str, "the right answer to the control; the right answer to the void is to abstain"]
    lite: Lite
    source: Annotated[str, "where the clips are from: simulated, or what the importer of a recorded pair states"]
    licence: Annotated[str, "of the clips; SPDX id, or what the importer of a recorded pair states"]
    benchmark_version: shared.BenchmarkVersion
    canary: Canary


PAIRS = Table("pairs", PairRow, partition_by=(), key=("pair_id",))


@dataclass(frozen=True, kw_only=True)
class ReleasedItemRow(ItemRow):
    """A question about one clip as it is released; items of arms have an arm as dataset."""

    file_name: Annotated[str, "mp4, relative to this table's folder"]
    lite: Lite
    canary: Canary


RELEASED_ITEMS = Table("items", ReleasedItemRow, partition_by=(), key=("item_id",))


@dataclass(frozen=True, kw_only=True)
class HeldOutItemRow:
    """An item without its answer; neither name nor place tells its side or pair."""

    item: Annotated[str, "an opaque name, by which answers are sent in"]
    question: shared.Question
    file_name: Annotated[str, "mp4, relative to this table's folder; named by its content"]
    media_digest: shared.MediaDigest
    canary: Canary


HELD_OUT_ITEMS = Table("items", HeldOutItemRow, partition_by=(), key=("item",))


@dataclass(frozen=True, kw_only=True)
class ScenarioRow(SceneSpecRow):
    """A scenario: its whole record, from which its clips were rendered."""

    canary: Canary


SCENARIOS = Table("scenarios", ScenarioRow, partition_by=(), key=("scenario_id",))


@dataclass(frozen=True, kw_only=True)
class TwoEventsRow:
    """A scenario of two events: its record, from which its four clips were rendered."""

    scenario_id: shared.ScenarioId
    record: Annotated[str, "JSON: family, question, both lanes with their twins, camera, boards, certificates"]
    canary: Canary


TWO_EVENTS_SCENARIOS = Table("two_events", TwoEventsRow, partition_by=(), key=("scenario_id",))


@dataclass(frozen=True, kw_only=True)
class CertificateRow:
    """A certificate of a scenario's pair, checked against its record's numbers."""

    scenario_id: shared.ScenarioId
    certificate: Annotated[str, "name of the certificate"]
    about: Annotated[str, "control, void, twin, worlds or words"]
    promises: Annotated[str, "what it promises"]
    holds: Annotated[bool, "whether the stored numbers meet every threshold"]
    failure: Annotated[str | None, "what is wrong; null where it holds"]
    evidence: Annotated[str, "JSON: the numbers of this certificate that the record stores"]
    canary: Canary


CERTIFICATES = Table("certificates", CertificateRow, partition_by=(), key=("scenario_id", "certificate"))


@dataclass(frozen=True, kw_only=True)
class SplitRow:
    """The membership of a scenario in a split."""

    split: Annotated[str, "test (all of the folder), or lite (200 scenarios that keep most of a ranking)"]
    scenario_id: shared.ScenarioId
    canary: Canary


SPLITS = Table("splits", SplitRow, partition_by=(), key=("split", "scenario_id"))


@dataclass(frozen=True, kw_only=True)
class PromptRow:
    """A prompt, as it is sent."""

    name: Annotated[str, "regime of the system prompt, or the judges' task"]
    role: Annotated[str, "system prompt of a model, or prompt of a judge"]
    text: Annotated[str, "the whole text"]
    version: Annotated[str, "digest of the text"]
    licence: Annotated[str, "SPDX id"]
    canary: Canary


PROMPTS = Table("prompts", PromptRow, partition_by=(), key=("role", "name"))


@dataclass(frozen=True, kw_only=True)
class SubmittedRow(LeaderboardRow):
    """An entry of a leaderboard of submissions, ranked among those of its group."""

    submission: Annotated[str, "the submission that its answers and votes are from"]
    group: Annotated[str, "digest of items, and panel: entries of different groups are not ranked together"]


SUBMITTED = Table("submitted", SubmittedRow, partition_by=(), key=("group", "model", "regime", "dataset"))

OPEN = (PAIRS, RELEASED_ITEMS, SCENARIOS, TWO_EVENTS_SCENARIOS, CERTIFICATES, SPLITS, PROMPTS)
HELD_OUT = (HELD_OUT_ITEMS, PROMPTS)
