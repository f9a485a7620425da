"""Validate the confabulation judge against two annotators (docs/spec.md 6.3).

`annotation_sheet` writes the annotators' material: question, void kind, answer, and the trace if the judge saw it; a
sample id replaces model and item. Their labels come back as one CSV file with a line per annotator and failure.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.sheets import no_formula
from traps_pipeline.base.terminal import text_table
from traps_pipeline.base.wording import count_noun
from traps_pipeline.judging.agreement import cohen_kappa
from traps_pipeline.judging.confabulation import draw_sample, sample_id
from traps_pipeline.judging.confabulation_protocol import TRACE_AND_OUTPUT, VOID_KINDS, load_protocol
from traps_pipeline.judging.judging_rows import CONFABULATION, JUDGE_VALIDATION
from traps_pipeline.models.asking.answer_rows import RESPONSES
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace

LABEL_COLUMNS = ("annotator", "sample_id", *AXES)
SHEET_COLUMNS = (*LABEL_COLUMNS, "question", "why_unanswerable", "reasoning_trace", "response")
YES_WORDS, NO_WORDS = ("1", "true", "yes"), ("0", "false", "no")
DEGENERATE_SHARE = 0.02
POOLED = "pooled"
RESAMPLES, SEED = 10_000, 20260101
_MAX_PROBLEMS = 5


@dataclass(frozen=True)
class HumanLabels:
    """Two annotators' labels. annotators: sorted by name. sample_ids: failures. labels: (2, failures, axes)."""

    annotators: tuple[str, str]
    sample_ids: tuple[str, ...]
    labels: np.ndarray


# --- the annotators' files --------------------------------------------------------------------------------------------


def sheet_rows(workspace: Workspace) -> list[dict[str, str]]:
    """Return an annotator's material for each failure, ordered to reveal nothing.

    Columns sample_id, question, why_unanswerable, reasoning_trace (empty without one) and response. Raises TrapsError
    if no failure of the models to validate was labelled, or if a failure's answer has been replaced.
    """
    protocol = load_protocol()
    labels = _judged_failures(workspace)
    labels = labels.loc[labels["model"].isin(protocol.validation.models)].set_index("sample_id")
    if labels.empty:
        raise TrapsError(f"no labelled failure of {', '.join(protocol.validation.models)}; run the study first")
    drawn_keys = draw_sample(protocol.seed, protocol.validation.n, [(str(sample), "sheet") for sample in labels.index])
    return [_sheet_row(workspace, sample, labels.loc[sample].to_dict()) for sample, _ in drawn_keys]


def annotation_sheet(workspace: Workspace) -> list[dict[str, str]]:
    """Return an annotator's rows (SHEET_COLUMNS), safe for a spreadsheet."""
    empty = dict.fromkeys(LABEL_COLUMNS, "")
    return [
        empty | {name: str(no_formula(text)) for name, text in row.items()} | {"sample_id": row["sample_id"]}
        for row in sheet_rows(workspace)
    ]


def _sheet_row(workspace: Workspace, sample: str, label: Mapping[str, Any]) -> dict[str, str]:
    evaluation, item_id = Evaluation(label["model"], label["regime"], int(label["run"])), label["item_id"]
    cell = Cell(label["dataset"], evaluation)
    response = _row_of(workspace.tables.read(RESPONSES, cell.partition, ["item_id", "text", "reasoning"]), item_id)
    item = _row_of(workspace.tables.read(ITEMS, {"dataset": cell.dataset}, ["item_id", "question"]), item_id)
    trace = response.get("reasoning") if label["evidence"] == TRACE_AND_OUTPUT else None
    if not item or sample_id(cell, item_id, response.get("text"), trace) != sample:
        raise TrapsError(
            f"{workspace.root}: the labels of {cell.key} are of earlier answers (of {item_id}, for one); materialize "
            "confabulation, then write the sheet again"
        )
    return {
        "sample_id": sample,
        "question": str(item["question"]),
        "why_unanswerable": VOID_KINDS[label["void_kind"]],
        "reasoning_trace": str(trace or ""),
        "response": str(response["text"]),
    }


def _row_of(frame: pd.DataFrame, item_id: str) -> dict[Any, Any]:
    """Return the texts of an item's row; empty if there is no row."""
    rows = frame.loc[frame["item_id"] == item_id].to_dict("records")
    return {name: value for row in rows for name, value in row.items() if isinstance(value, str)}


def write_sheet(rows: Sequence[Mapping[str, str]], path: Path, columns: Sequence[str] = SHEET_COLUMNS) -> None:
    """Write a sheet, or only LABEL_COLUMNS, as CSV. Raises TrapsError if it exists."""
    if path.exists():
        raise TrapsError(f"{path} exists already and may hold labels; give another name, or delete it")
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows([row[name] for name in columns] for row in rows)


def read_labels(path: Path, samples: Sequence[str]) -> HumanLabels:
    """Return two annotators' labels from a CSV file of LABEL_COLUMNS.

    Values are true/false, yes/no or 1/0. known: sample ids that the judge has labelled. Raises TrapsError naming the
    lines and columns that are wrong.
    """
    labels: dict[tuple[str, str], tuple[int, list[bool]]] = {}
    line_problems: list[str] = []
    for line, row in _lines(path):
        annotator, sample = row["annotator"], row["sample_id"]
        problems = [f"{name} is empty" for name in ("annotator", "sample_id") if not row[name]]
        if sample and sample not in samples:
            problems.append(f"sample_id {sample!r:.40} is not a failure that the judge has labelled")
        problems += [
            f"{axis} is {row[axis]!r:.40}; write 1 or 0, true or false, yes or no"
            for axis in AXES
            if row[axis].lower() not in (*YES_WORDS, *NO_WORDS)
        ]
        if (annotator, sample) in labels:
            problems.append(f"{annotator:.40} has already labelled {sample:.40} on line {labels[annotator, sample][0]}")
        line_problems += [f"{path}:{line}: {problem}" for problem in problems]
        labels.setdefault((annotator, sample), (line, [row[axis].lower() in YES_WORDS for axis in AXES]))
    _refuse(line_problems)
    return _pair_labels(path, labels)


def _lines(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield a CSV file's numbered rows, with LABEL_COLUMNS as stripped texts."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in LABEL_COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                column_names = ", ".join(LABEL_COLUMNS)
                raise TrapsError(f"{path}:1: column {', '.join(missing)} is missing; it needs {column_names}")
            for row in reader:
                yield reader.line_num, {name: (row[name] or "").strip() for name in LABEL_COLUMNS}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TrapsError(f"{path}: cannot be read as CSV ({error})") from error


def _pair_labels(path: Path, by_sample: Mapping[tuple[str, str], tuple[int, list[bool]]]) -> HumanLabels:
    names = sorted({annotator for annotator, _ in by_sample})
    if len(names) != 2:
        raise TrapsError(
            f"{path}: has {count_noun(len(names), 'annotator')} ({', '.join(names)[:80] or 'none'}); "
            "it needs exactly two"
        )
    first, second = names
    samples = sorted({sample for _, sample in by_sample})
    unpaired = [
        (a, s, line) for (a, s), (line, _) in by_sample.items() if (second if a == first else first, s) not in by_sample
    ]
    _refuse([f"{path}:{line}: only {a:.40} has labelled {s:.40}; both annotators must" for a, s, line in unpaired])
    labels = np.array([[by_sample[name, sample][1] for sample in samples] for name in names], bool)
    return HumanLabels((first, second), tuple(samples), labels)


def _refuse(wrong: Sequence[str]) -> None:
    if wrong:
        suffix = f"\n... and {len(wrong) - _MAX_PROBLEMS} more" if len(wrong) > _MAX_PROBLEMS else ""
        raise TrapsError("\n".join(wrong[:_MAX_PROBLEMS]) + suffix)


# --- the comparison ---------------------------------------------------------------------------------------------------


def validation_rows(workspace: Workspace, path: Path) -> pd.DataFrame:
    """Write and return JUDGE_VALIDATION rows from a label file. Raises TrapsError."""
    judged = _judged_failures(workspace).set_index("sample_id")
    if judged.empty:
        raise TrapsError(f"{workspace.root}: the study has no labelled failure to compare with; run it first")
    human = read_labels(path, list(map(str, judged.index)))
    rows = compare(judged.loc[list(human.sample_ids), [*AXES]].to_numpy(bool), human)
    state = workspace.tables.state(CONFABULATION, {})
    inputs = {"confabulation": state.version if state else "", "labels": file_digest(path)}
    workspace.tables.write(JUDGE_VALIDATION, {}, rows, inputs)
    return rows


def _judged_failures(workspace: Workspace) -> pd.DataFrame:
    labels = workspace.tables.read(CONFABULATION, {})
    return labels.loc[labels["valid"].to_numpy(bool)]


def compare(judge: np.ndarray, human: HumanLabels) -> pd.DataFrame:
    """Return JUDGE_VALIDATION rows that compare the judge with both annotators.

    judge: its labels, (failures, axes) of bool. Pooled labels are both annotators' labels side by side, without a
    consensus: 2 x failures per axis.
    """
    rows = [_axis_row(axis, judge[:, k], human.labels[:, :, k], human) for k, axis in enumerate(AXES)]
    agreements = [float(np.mean(human.labels[k] == judge)) for k in (0, 1)]
    rows.append(
        _shared_columns(POOLED, judge.shape[0], human)
        | {"n_labels": 2 * judge.size, "accuracy": float(np.mean(human.labels == judge))}
        | {"accuracy_a": agreements[0], "accuracy_b": agreements[1]}
        | {"human_agreement": float(np.mean(human.labels[0] == human.labels[1]))}
    )
    return pd.DataFrame(rows, columns=pd.Index(JUDGE_VALIDATION.names))


def _shared_columns(axis: str, failures: int, human: HumanLabels) -> dict[str, Any]:
    a, b = human.annotators
    return {"axis": axis, "n_failures": failures, "annotator_a": a, "annotator_b": b}


def _axis_row(axis: str, judge: np.ndarray, labels: np.ndarray, human: HumanLabels) -> dict[str, Any]:
    """Return the row of an axis. judge: (failures,); labels: (2, failures)."""
    first, second = labels
    hits = int((labels & judge).sum())
    precision, recall = _share(hits, 2 * int(judge.sum())), _share(hits, int(labels.sum()))
    defined = judge.any() and labels.any()  # whether both precision and recall are defined
    kappa, low, high = _kappa(first, second)
    return _shared_columns(axis, len(judge), human) | {
        "n_labels": labels.size,
        "accuracy": float(np.mean(labels == judge)),
        "precision": precision,
        "recall": recall,
        "f1": _share(2 * hits, 2 * int(judge.sum()) + int(labels.sum())) if defined else np.nan,
        "accuracy_a": float(np.mean(first == judge)),
        "accuracy_b": float(np.mean(second == judge)),
        "human_agreement": float(np.mean(first == second)),
        "human_kappa": kappa,
        "human_kappa_low": low,
        "human_kappa_high": high,
        "kappa_note": "degenerate" if np.isnan(kappa) else None,
    }


def is_degenerate(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether one class is at most 2 % of labels, so that kappa means nothing."""
    return any(min(np.mean(labels), 1 - np.mean(labels)) <= DEGENERATE_SHARE + 1e-12 for labels in (one, other))


def _kappa(first: np.ndarray, second: np.ndarray) -> tuple[float, float, float]:
    """Return Cohen's kappa and its 95 % interval, a Bayesian bootstrap with one failure unseen; NaN if degenerate."""
    if is_degenerate(first, second):
        return np.nan, np.nan, np.nan
    cells = np.bincount(2 * first.astype(int) + second, minlength=4)  # no and no, no and yes, yes and no, yes and yes
    rng = np.random.default_rng(SEED)
    gamma, unseen_weights = rng.standard_gamma(cells, (RESAMPLES, 4)), rng.standard_exponential((RESAMPLES, 1))
    shares = gamma + np.eye(4)[:, None] * unseen_weights  # (cell of the unseen failure, resamples, cells)
    shares /= shares.sum(axis=-1, keepdims=True)
    p, q = shares[..., 2] + shares[..., 3], shares[..., 1] + shares[..., 3]
    chance = p * q + (1 - p) * (1 - q)
    draws = (shares[..., 0] + shares[..., 3] - chance) / (1 - chance)
    kappa = cohen_kappa(first.astype(int), second.astype(int))
    low, high = np.quantile(draws[1:3].min(axis=0), 0.025), np.quantile(draws[[0, 3]].max(axis=0), 0.975)
    return kappa, min(float(low), kappa), max(float(high), kappa)


def _share(part: int, total: int) -> float:
    return part / total if total else np.nan


def validation_text(rows: pd.DataFrame) -> str:
    """Return JUDGE_VALIDATION rows as text for people."""
    first = rows.iloc[0]
    failures = count_noun(first["n_failures"], "failure")
    title = f"judge against {first['annotator_a']} (A) and {first['annotator_b']} (B), {failures}"
    headings = ["axis", "labels", "acc", "prec", "recall", "F1", "vs A", "vs B", "A = B", "kappa", "95 %"]
    shares = ("accuracy", "precision", "recall", "f1", "accuracy_a", "accuracy_b", "human_agreement")
    cells = [
        [row["axis"], row["n_labels"], *(_number(row[name]) for name in shares), *_kappa_cells(row)]
        for row in rows.to_dict("records")
    ]
    return f"{title}\n{text_table(headings, cells)}"


def _kappa_cells(row: Mapping[Any, Any]) -> tuple[str, str]:
    """Return kappa, or the reason for its absence, and its interval."""
    if pd.notna(row["kappa_note"]):
        return row["kappa_note"], ""
    if np.isnan(row["human_kappa"]):
        return "", ""
    return f"{row['human_kappa']:.2f}", f"{row['human_kappa_low']:.2f} to {row['human_kappa_high']:.2f}"


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.3f}"
