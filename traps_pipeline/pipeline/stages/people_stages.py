"""People's labels: what they labelled, how far they agree, their row, and scores corrected by them."""

from typing import TYPE_CHECKING

from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.people.human_label_rows import HUMAN_AGREEMENT, HUMAN_LABELS, PROTOCOL_FILE, labels_version
from traps_pipeline.people.human_score_rows import CORRECTED, HUMAN_ROW, PANEL_ERRORS
from traps_pipeline.pipeline.stage import of, source, stage
from traps_pipeline.pipeline.stages.benchmark_stages import items
from traps_pipeline.pipeline.stages.evaluation_stages import judges, responses, verdicts
from traps_pipeline.pipeline.stages.judging_stages import confabulation
from traps_pipeline.pipeline.stages.tables_shown import made_of
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

GROUP = "people"


def _protocol_version(workspace: Workspace, key: None) -> str:
    from traps_pipeline.base.digests import file_digest

    return file_digest(PROTOCOL_FILE)[:16]


people = source(
    "people",
    lambda workspace, key: labels_version(workspace.labels),
    group=GROUP,
    doc="The labels that people gave on the pages of `traps people annotate`, as they were appended.",
    kinds=["json"],
)
annotation_protocol = source(
    "annotation_protocol",
    _protocol_version,
    group=GROUP,
    doc="assets/annotation.yaml: the samples that people label, and what counts as judges being split.",
    kinds=["yaml"],
)


def _make_labels(workspace: Workspace, _: None) -> StageOutput:
    """Return people's labels of clips and answers that the study has, each with its item and what the panel decided;
    empty until somebody has labelled."""
    from traps_pipeline.people.labels import human_labels

    return StageOutput(human_labels(workspace))


def _make_agreement(workspace: Workspace, _: None) -> StageOutput:
    """Return how far people agree, by task and decision."""
    from traps_pipeline.people.labels import human_agreement

    return made_of("agreement of people", HUMAN_AGREEMENT, human_agreement(workspace.tables.read(HUMAN_LABELS, {})))


def _make_row(workspace: Workspace, _: None) -> StageOutput:
    """Return Acc, AbsRec, FalseAbs and PECS of people with intervals, their agreement, and the seconds that a clip
    takes."""
    from traps_pipeline.people.human_scores import human_row

    return made_of("people", HUMAN_ROW, human_row(workspace.tables.read(HUMAN_LABELS, {})))


def _labels_and_verdicts(workspace: Workspace) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """Return all HUMAN_LABELS rows, and the VERDICTS rows of the study's panel."""
    from traps_pipeline.models.judges import panel_id
    from traps_pipeline.storage.benchmark_tables import current_rows

    labels = workspace.tables.read(HUMAN_LABELS, {})
    judged = current_rows(workspace, VERDICTS, dataset=DATASETS if len(labels) else ())  # they are many
    own = judged.loc[judged["panel"] == panel_id(workspace.study.panel)]
    return labels, own.reset_index(drop=True)


def _make_errors(workspace: Workspace, _: None) -> StageOutput:
    """Return sensitivity and specificity of the panel against people, by task; empty while it is not validated."""
    from traps_pipeline.people.corrected_scores import panel_errors

    return made_of("the panel against people", PANEL_ERRORS, panel_errors(*_labels_and_verdicts(workspace)))


def _make_corrected(workspace: Workspace, _: None) -> StageOutput:
    """Return every entry of the leaderboard as judged, and corrected for the panel's errors."""
    from traps_pipeline.people.corrected_scores import corrected

    return made_of("judged and corrected", CORRECTED, corrected(*_labels_and_verdicts(workspace)))


_LABELLED = tuple(of(one, need="none") for one in (items, responses, verdicts, confabulation))
human_labels = stage(
    HUMAN_LABELS,
    _make_labels,
    group=GROUP,
    parents=[*_LABELLED, people, annotation_protocol, judges],
)
_AGAINST = (human_labels, of(verdicts, need="none"), judges)
human_agreement = stage(HUMAN_AGREEMENT, _make_agreement, group=GROUP, parents=[human_labels])
human_row = stage(HUMAN_ROW, _make_row, group=GROUP, code="2", parents=[human_labels])
panel_errors = stage(PANEL_ERRORS, _make_errors, group=GROUP, code="2", parents=_AGAINST)
corrected = stage(CORRECTED, _make_corrected, group=GROUP, code="2", parents=_AGAINST)
