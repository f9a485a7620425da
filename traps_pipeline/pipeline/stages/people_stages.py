"""Declare people's labels, agreement, scores, and scores corrected by them."""

from functools import partial
from typing import TYPE_CHECKING

from traps_pipeline.base.digests import file_digest
from traps_pipeline.judging.judging_rows import VERDICTS
from traps_pipeline.models.registry.judges import panel_id
from traps_pipeline.people.human_label_rows import HUMAN_AGREEMENT, HUMAN_LABELS, PROTOCOL_FILE, labels_version
from traps_pipeline.people.human_score_rows import CORRECTED, HUMAN_ROW, PANEL_ERRORS
from traps_pipeline.pipeline.stage import dep, source, stage
from traps_pipeline.pipeline.stages.benchmark_stages import items
from traps_pipeline.pipeline.stages.evaluation_stages import judges, responses, verdicts
from traps_pipeline.pipeline.stages.judging_stages import confabulation
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.storage.benchmark_tables import current_rows
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

_stage, _source = partial(stage, group="people"), partial(source, group="people")


@_source(kinds=["json"])
def people(workspace: Workspace, _: None) -> str:
    """Return the version of labels submitted on the pages of `traps people annotate`."""
    return labels_version(workspace.labels)


@_source(kinds=["yaml"])
def annotation_protocol(workspace: Workspace, _: None) -> str:
    """Return the version of the annotation protocol.

    assets/annotation.yaml defines the samples that people label, and a split panel.
    """
    return file_digest(PROTOCOL_FILE)[:16]


_LABELLED = tuple(dep(one, need="none") for one in (items, responses, verdicts, confabulation))


@_stage(HUMAN_LABELS, parents=[*_LABELLED, people, annotation_protocol, judges])
def human_labels(workspace: Workspace, _: None) -> StageOutput:
    """Return people's labels of clips and answers, with item and panel's decision.

    The table is empty until somebody has labelled.
    """
    from traps_pipeline.people.labels import human_labels as rows_of

    return StageOutput(rows_of(workspace))


@_stage(HUMAN_AGREEMENT, parents=[human_labels])
def human_agreement(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return the agreement between people, by task and decision."""
    from traps_pipeline.people.labels import human_agreement as rows_of

    return rows_of(workspace.tables.read(HUMAN_LABELS, {}))


@_stage(HUMAN_ROW, parents=[human_labels])
def human_row(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return people's Acc, AbsRec, FalseAbs, PECS, agreement and seconds per clip."""
    from traps_pipeline.people.human_scores import human_row as rows_of

    return rows_of(workspace.tables.read(HUMAN_LABELS, {}))


def _labels_and_verdicts(workspace: Workspace) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """Return all HUMAN_LABELS rows, and the VERDICTS rows of the study's panel."""
    labels = workspace.tables.read(HUMAN_LABELS, {})
    judged = current_rows(workspace, VERDICTS, dataset=DATASETS if len(labels) else ())  # verdicts are many
    panel_verdicts = judged.loc[judged["panel"] == panel_id(workspace.study.panel)]
    return labels, panel_verdicts.reset_index(drop=True)


_VALIDATION_PARENTS = (human_labels, dep(verdicts, need="none"), judges)


@_stage(PANEL_ERRORS, parents=_VALIDATION_PARENTS)
def panel_errors(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return the panel's sensitivity and specificity against people, by task.

    It is empty until the panel is validated.
    """
    from traps_pipeline.people.corrected_scores import panel_errors as rows_of

    return rows_of(*_labels_and_verdicts(workspace))


@_stage(CORRECTED, parents=_VALIDATION_PARENTS)
def corrected(workspace: Workspace, _: None) -> "pd.DataFrame":
    """Return every leaderboard entry as judged, and corrected for panel errors."""
    from traps_pipeline.people.corrected_scores import corrected as rows_of

    return rows_of(*_labels_and_verdicts(workspace))
