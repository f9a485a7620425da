"""Read people's labels of the study's units, and their agreement, into tables.

`traps people annotate` appends each label to `labels.jsonl`, one line with a checksum per label; a later line of the
same person about the same unit replaces the earlier one. Stages read only that file.
"""

import json
from collections.abc import Mapping
from datetime import datetime
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, StrictBool, ValidationError, create_model

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.yamlfile import faults_of
from traps_pipeline.judging.agreement import krippendorff_alpha
from traps_pipeline.models.reading.judged_answers import is_correct
from traps_pipeline.people.human_label_rows import HUMAN_AGREEMENT, HUMAN_LABELS, LABELS_FILE
from traps_pipeline.people.label_units import ABOUT_ANSWERS, TASKS, TaskName, label_units, strata
from traps_pipeline.protocol.ratings import AXES, INVALID, NO, YES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.lines import NOT_WHOLE, read_checked
from traps_pipeline.storage.workspace import Workspace

MAX_CHARACTERS = 200  # limit of an answer
DECISIONS: Mapping[TaskName, tuple[str, ...]] = {
    "answerability": ("abstained",),
    "confabulation": AXES,
    "abstention": ("abstained",),
    "correctness": ("correct",),
}
_STRICT = ConfigDict(extra="forbid", frozen=True)


class ClipLabel(BaseModel):
    """A person's answer about a clip and its question; null if it cannot be known."""

    model_config = _STRICT
    answer: str | None = Field(min_length=1, max_length=MAX_CHARACTERS)


# In the other tasks, a person only states decisions.
_model: Any = create_model  # its fields are known only at run time
LABELS: Mapping[TaskName, type[BaseModel]] = {
    task: ClipLabel
    if task == "answerability"
    else _model(task, __config__=_STRICT, **dict.fromkeys(DECISIONS[task], (StrictBool, ...)))
    for task in TASKS
}


class Line(BaseModel):
    """A line of `labels.jsonl`; seq counts the labels of all people."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    seq: int = Field(ge=1)
    task: TaskName
    unit: str
    who: str = Field(min_length=1)
    at: datetime
    seconds: float = Field(ge=0)
    label: dict[str, Any]


def label_lines(folder: Path) -> list[Line]:
    """Return a study's labels in order; none if nobody has labelled.

    Raises TrapsError for a damaged line; a last line that a crash cut off was never confirmed and is left out.
    """
    path, lines = folder / LABELS_FILE, list[Line]()
    if not path.is_file():
        return lines
    for line in read_checked(path):
        if line.torn:
            continue
        if not line.whole:
            raise TrapsError(f"{path}:{line.number}: is {NOT_WHOLE}; restore the file from a copy")
        try:
            label = Line.model_validate_json(line.content)
            LABELS[label.task].model_validate(label.label)
        except ValidationError as error:
            raise TrapsError(f"{path}:{line.number}: {faults_of(error)}") from error
        lines.append(label)
    return lines


# --- labels of what the study has -------------------------------------------------------------------------------------


def human_labels(workspace: Workspace) -> pd.DataFrame:
    """Return HUMAN_LABELS: each person's last label of each unit still in the study."""
    last: dict[tuple[TaskName, str, str], dict[str, Any]] = {}
    for line in label_lines(workspace.labels):
        key = line.task, line.unit, line.who
        row = {"task": line.task, "unit": line.unit, "annotator": line.who, "created_at": line.at, **line.label}
        last[key] = row | {"seconds": last[key]["seconds"] if key in last else line.seconds}
    latest, frames = pd.DataFrame(list(last.values())), list[pd.DataFrame]()
    for task in TASKS if len(latest) else ():
        labels = latest.loc[latest["task"] == task]
        if len(labels):
            population = label_units(workspace, task)
            population["stratum"] = strata(population)
            population["stratum_size"] = population.groupby("stratum")["unit"].transform("size")
            frames.append(labels.merge(population, on="unit", how="inner", validate="many_to_one"))
    if not frames:
        return pd.DataFrame(columns=pd.Index(HUMAN_LABELS.names))
    rows = pd.concat(frames, ignore_index=True).reindex(columns=pd.Index(HUMAN_LABELS.names))
    return _with_answers(workspace, rows.astype(object).where(rows.notna(), None))


def _with_answers(workspace: Workspace, rows: pd.DataFrame) -> pd.DataFrame:
    """Add whether people's answers about clips abstain, or are correct on a control."""
    columns = ["item_id", "ground_truth", "answer_type", "labels", "aliases"]
    items = workspace.tables.read_all(ITEMS, columns).set_index("item_id").to_dict("index")

    def right(row: Mapping[Any, Any]) -> bool:
        item = items[row["item_id"]]
        aliases = json.loads(item["aliases"])
        read = is_correct(row["answer"], item["ground_truth"], item["answer_type"], list(item["labels"]), aliases)
        return read is True

    answers = []
    for row in rows.to_dict("records"):
        if row["task"] == "answerability":
            row["abstained"] = row["answer"] is None
            row["correct"] = right(row) if row["side"] == "control" else None
        answers.append(row)
    return pd.DataFrame(answers, columns=pd.Index(HUMAN_LABELS.names))


# --- agreement --------------------------------------------------------------------------------------------------------


def human_agreement(labels: pd.DataFrame) -> pd.DataFrame:
    """Return HUMAN_AGREEMENT rows from HUMAN_LABELS rows."""
    rows = []
    for task in TASKS:
        task_labels = labels.loc[labels["task"] == task]
        rows += [_agreement(task, decision, task_labels) for decision in DECISIONS[task] if len(task_labels)]
    return pd.DataFrame(rows, columns=pd.Index(HUMAN_AGREEMENT.names))


def _agreement(task: TaskName, decision: str, labels: pd.DataFrame) -> dict[str, Any]:
    values = label_matrix(labels, decision)
    n_shared, equal_share, alpha = agreement_of(values)
    reason = "every label is the same" if n_shared else "nothing was labelled by two people"
    return {
        "task": task,
        "decision": decision,
        "annotators": "+".join(sorted(labels["annotator"].unique())),
        "n_labels": len(labels),
        "n_units": len(values),
        "n_shared": n_shared,
        "agreement": equal_share,
        "alpha": alpha,
        "undefined": reason if np.isnan(alpha) else None,
        "seconds": float(np.median(labels["seconds"].to_numpy(float))),
    }


def agreement_of(values: np.ndarray) -> tuple[int, float, float]:
    """Return the agreement between labels in the form of `label_matrix`; NaN if undefined.

    Three values: the number of units with two people or more, the share of equal pairs of labels of the same unit, and
    Krippendorff's alpha.
    """
    n_shared_units = int(((values != INVALID).sum(axis=1) > 1).sum())
    pairs = [values[:, [a, b]] for a, b in combinations(range(values.shape[1]), 2)]
    shared_pairs = np.concatenate(
        [label_pair[(label_pair != INVALID).all(axis=1)] for label_pair in pairs] or [np.zeros((0, 2), np.int8)]
    )
    equal_share = float((shared_pairs[:, 0] == shared_pairs[:, 1]).mean()) if len(shared_pairs) else float("nan")
    return n_shared_units, equal_share, krippendorff_alpha(values) if n_shared_units else float("nan")


def label_matrix(labels: pd.DataFrame, decision: str) -> np.ndarray:
    """Return labels as YES, NO, INVALID (unlabelled): (units, people) int8, sorted."""
    names, people = (sorted(labels[column].unique()) for column in ("unit", "annotator"))
    values = np.full((len(names), len(people)), INVALID, np.int8)
    places = (
        pd.Index(names).get_indexer(pd.Index(labels["unit"])),
        pd.Index(people).get_indexer(pd.Index(labels["annotator"])),
    )
    values[places] = np.where(labels[decision].astype(bool), YES, NO)
    return values


def true_labels(labels: pd.DataFrame, task: TaskName) -> pd.DataFrame:
    """Return the majority about each unit of ABOUT_ANSWERS in columns of HUMAN_LABELS, with `truth` (null: a tie)."""
    if task not in ABOUT_ANSWERS:
        raise ValueError(f"{task}: the panel decides nothing of the kind")
    task_labels = labels.loc[labels["task"] == task]
    share = task_labels[DECISIONS[task][0]].astype(bool).groupby(task_labels["unit"]).mean()
    first = task_labels.sort_values("annotator").drop_duplicates("unit")
    yes_share = first["unit"].map(share)
    return first.assign(truth=np.where(yes_share == 0.5, None, yes_share > 0.5))


def confabulation_rows(labels: pd.DataFrame) -> list[dict[str, str]]:
    """Return confabulation labels as `traps people validate` reads them.

    labels: HUMAN_LABELS rows. The result covers failures that every annotator has labelled. Raises TrapsError if there
    are none.
    """
    task_labels = labels.loc[labels["task"] == "confabulation"]
    is_labelled_by_all = (
        task_labels.groupby("unit")["annotator"].transform("nunique") == task_labels["annotator"].nunique()
    )
    shared_labels = task_labels.loc[is_labelled_by_all.to_numpy(bool)]
    if shared_labels.empty:
        raise TrapsError("no failure is labelled by everybody yet; label some on the pages of `traps people annotate`")
    return [
        {"annotator": row["annotator"], "sample_id": row["unit"], **{axis: str(int(row[axis])) for axis in AXES}}
        for row in shared_labels.sort_values(["annotator", "unit"]).to_dict("records")
    ]
