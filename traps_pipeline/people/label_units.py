"""List the clips and answers that people label, and sample them (docs/people.md).

Everything that a task could label is a unit. Its id is a digest of the shown content, so that people's labels of one
clip or answer are never taken for labels of another. A task's units are in groups, and each group in two strata: those
that split the judges, and the others. The units with the smallest digests of a stratum are sampled, so that labels of a
stratum are a random sample of it, and metrics can weight each stratum by its share in the study.
"""

from functools import cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.yamlfile import parse_yaml_model, read_yaml
from traps_pipeline.benchmark.records import is_recorded
from traps_pipeline.judging.confabulation_protocol import load_protocol
from traps_pipeline.judging.judging_rows import CONFABULATION, VERDICTS
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.models.registry.judges import panel_id
from traps_pipeline.people.human_label_rows import PROTOCOL_FILE
from traps_pipeline.people.judge_validation import sheet_rows
from traps_pipeline.protocol.datasets import DATASETS, TWO_EVENTS, is_ill_posed
from traps_pipeline.storage.benchmark_tables import ITEMS, current_rows
from traps_pipeline.storage.workspace import Workspace

TaskName = Literal["answerability", "confabulation", "abstention", "correctness"]
TASKS: tuple[TaskName, ...] = get_args(TaskName)
ABOUT_ANSWERS: tuple[TaskName, ...] = ("abstention", "correctness")  # tasks in which people make the panel's decisions
UNIT_COLUMNS = (
    *("unit", "item_id", "dataset", "scenario_id", "side", "model", "regime", "run"),
    *("group", "split", "panel", "benchmark_version"),
)
_ANSWER = ["dataset", "model", "regime", "run", "item_id"]
_UNIT_DIGITS = 16


class Sizes(BaseModel):
    """The sample sizes of each group of a task."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    answerability: int = Field(ge=1)
    abstention: int = Field(ge=1)
    correctness: int = Field(ge=1)


class AnnotationProtocol(BaseModel):
    """The contents of `assets/annotation.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    seed: int
    sizes: Sizes
    split_share: float = Field(ge=0, le=1)
    split_from: float = Field(gt=0, le=1)
    sitting_hours: float = Field(gt=0)
    certified_by: int = Field(ge=1)


@cache
def annotation_protocol(path: Path = PROTOCOL_FILE) -> AnnotationProtocol:
    """Return the protocol. Raises TrapsError naming the wrong field."""
    return parse_yaml_model(AnnotationProtocol, read_yaml(path), path)


def label_units(workspace: Workspace, task: TaskName) -> pd.DataFrame:
    """Return UNIT_COLUMNS of all units of a task in the study; may be empty.

    panel is the panel's decision (null except in ABOUT_ANSWERS); model, regime and run are null for clips.
    """
    if task == "answerability":
        clips = _clips(workspace)
    elif task == "confabulation":
        clips = _failures(workspace)
    else:
        clips = _answers(workspace, task)
    return clips.reindex(columns=pd.Index(UNIT_COLUMNS)).reset_index(drop=True)


def _clips(workspace: Workspace) -> pd.DataFrame:
    columns = ["item_id", "dataset", "scenario_id", "side", "item_hash", "benchmark_version"]
    datasets = (*DATASETS, TWO_EVENTS) if is_recorded() else DATASETS  # people certify both kinds of recordings
    items = workspace.tables.read_all(ITEMS, columns, dataset=datasets)
    verdicts = current_rows(workspace, VERDICTS, ["item_id", "n_valid", "unanimous"])
    judged = verdicts.loc[verdicts["n_valid"] > 0]
    contested_share = (~judged["unanimous"].astype(bool)).groupby(judged["item_id"]).mean()
    share = items["item_id"].map(contested_share).fillna(0.0)
    return items.assign(
        unit=[
            _unit("answerability", item, hash_)
            for item, hash_ in zip(items["item_id"], items["item_hash"], strict=True)
        ],
        group=items["dataset"] + " " + items["side"],
        split=share >= annotation_protocol().split_from,
    )


def _answers(workspace: Workspace, task: TaskName) -> pd.DataFrame:
    """Return the answers whose abstention or correctness the study's panel decided."""
    decision = "abstained" if task == "abstention" else "correct"
    verdicts = current_rows(workspace, VERDICTS, [*_ANSWER, "scenario_id", "side", "unanimous", "panel", decision])
    decided_rows = verdicts.loc[verdicts[decision].notna() & (verdicts["panel"] == panel_id(workspace.study.panel))]
    if decided_rows.empty:
        return decided_rows.assign(unit="")
    texts = workspace.tables.read_all(RESPONSES, [*_ANSWER, "text"], dataset=DATASETS)
    items = workspace.tables.read_all(
        ITEMS, ["item_id", "question", "ground_truth", "benchmark_version"], dataset=DATASETS
    )
    rows = decided_rows.merge(texts, on=_ANSWER, validate="one_to_one").merge(
        items, on="item_id", validate="many_to_one"
    )
    panel = rows[decision].astype(bool)
    fields = ["question"] if task == "abstention" else ["question", "ground_truth"]
    answers = rows[[*_ANSWER, *fields, "text"]].itertuples(index=False, name=None)
    return rows.assign(
        unit=[_unit(task, *map(str, answer_key)) for answer_key in answers],
        group=rows["side"] + np.where(panel, " yes", " no"),
        split=~rows["unanimous"].astype(bool),
        panel=panel,
    )


def _failures(workspace: Workspace) -> pd.DataFrame:
    """Return the failures that the confabulation judge labelled, to be sampled."""
    rows = workspace.tables.read_all(CONFABULATION)
    judged = rows.loc[rows["valid"].astype(bool) & rows["model"].isin(load_protocol().validation.models)]
    scenarios = judged["item_id"].str.split(":").str[1]
    return judged.assign(unit=judged["sample_id"], scenario_id=scenarios, side="void", group="failures", split=False)


def _unit(*shown: str) -> str:
    return digest([*shown])[:_UNIT_DIGITS]


def sample(workspace: Workspace, task: TaskName) -> pd.DataFrame:
    """Return the units sampled for people (`draw_sample`, or the sheet's failures)."""
    population = label_units(workspace, task)
    if population.empty:
        return population
    if task == "confabulation":
        sample_ids = {row["sample_id"] for row in sheet_rows(workspace)}
        return population.loc[population["unit"].isin(sorted(sample_ids))].reset_index(drop=True)
    protocol = annotation_protocol()
    size = getattr(protocol.sizes, task)
    certifies = task == "answerability" and is_recorded()
    unit_groups = [
        drawn_units(group, len(group) if certifies and not is_ill_posed(str(name).split()[0]) else size, protocol)
        for name, group in population.groupby("group", sort=True)
    ]
    return pd.concat(unit_groups, ignore_index=True)


def drawn_units(group: pd.DataFrame, size: int, protocol: AnnotationProtocol) -> pd.DataFrame:
    """Return a seeded sample of up to `size` units of a group, without replacement.

    A share comes from all units, then the rest from those that split the judges and, if these are too few, from all
    again.
    """
    order = [digest([protocol.seed, unit]) for unit in group["unit"]]
    ordered = group.iloc[np.argsort(order)]
    random_units = ordered.head(size - round(size * protocol.split_share))
    remaining_units = ordered.loc[~ordered["unit"].isin(random_units["unit"])]
    split_first = remaining_units.sort_values("split", ascending=False, kind="stable")
    return pd.concat([random_units, split_first.head(size - len(random_units))])


def strata(population: pd.DataFrame) -> pd.Series:
    """Return the stratum of each unit, on the frame's index."""
    split = np.where(population["split"].to_numpy(bool), ", split", "")
    return pd.Series(
        [f"{group}{part}" for group, part in zip(population["group"], split, strict=True)], population.index
    )


def personal_order(who: str, sampled: pd.DataFrame) -> list[str]:
    """Return the units of a sample in one person's order, seeded by their name."""
    seed = annotation_protocol().seed
    return sorted(map(str, sampled["unit"]), key=lambda unit: digest([seed, who, unit]))


def require_task(name: str) -> TaskName:
    """Return the task of that name. Raises TrapsError with the known names."""
    for task in TASKS:
        if task == name:
            return task
    raise TrapsError(f"{name}: no task of this name; choose from {', '.join(TASKS)}")
