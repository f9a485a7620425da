"""Arrange the paper's tables that it prints across: `arranged_*.csv`, and their columns in `tables.csv`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.printed_tables import COLUMNS, numbers, titled_rows
from traps_pipeline.report.tables.table_columns import DATASET, MODEL, with_titles
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.report.writing import Column
from traps_pipeline.scoring.analyses import models_of
from traps_pipeline.scoring.published import as_printed

Arranged = tuple[pd.DataFrame, list[Column]]

SHARES = {"acc_pct": "Acc %", "abs_rec_pct": "AbsRec %", "false_abs_pct": "FalseAbs %", "pecs": "PECS"}
SPREADS = ("acc_std", "abs_rec_std", "false_abs_std", "pecs_std")
PRINTED_REGIMES = ("standard", "json", "guided")  # in the paper's order
SIZES = {"occlusion": "202", "occlusion_ill_posed": "202", "chaotic": "500", "chaotic_ill_posed": "500"}
STEERED = {"qwen3-vl-8b": "L20", "gemma-4-e4b": "L35", "llava-next-video-7b": "L28"}
ALPHAS = ("0", "2", "5", "10")
SIDES = {"C": "control_abstention_pct", "V": "void_abstention_pct"}


def _wide(rows: pd.DataFrame, kept: list[str], parts: Iterable[tuple[pd.DataFrame, str, str, str]]) -> Arranged:
    """Return a row for each value of the last column kept, and a column for each part of the rows.

    parts: rows, field, name of the column and heading.
    """
    table = rows.loc[:, kept].drop_duplicates(ignore_index=True)
    columns = [COLUMNS[name] for name in kept]
    for part, field, name, heading in parts:
        table[name] = table[kept[-1]].map(part.set_index(kept[-1])[field])
        columns += numbers({name: heading})
    return table, columns


def _overall() -> Arranged:
    rows = as_printed("overall")
    parts = [
        (rows.loc[rows["regime"] == regime], field, f"{regime}_{field}", f"{heading}, {regime}")
        for regime in PRINTED_REGIMES
        for field, heading in SHARES.items()
    ]
    return _wide(rows, ["model"], parts)


def _cells(group: str) -> pd.DataFrame:
    """Return the cells of a group's models, `number ± spread` where both are printed."""
    cells: pd.DataFrame = as_printed("behavioral_per_dataset")
    cells = cells.loc[cells["model"].isin(models_of(group=group))].copy()
    for field, spread in zip(SHARES, SPREADS, strict=True):
        pairs = zip(cells[field], cells[spread], strict=True)
        cells[field] = [f"{value} ± {deviation}" if deviation else value for value, deviation in pairs]
    return cells


def _cells_of(cells: pd.DataFrame, dataset: str, regime: str) -> pd.DataFrame:
    return cells.loc[(cells["dataset"] == dataset) & (cells["regime"] == regime)]


def _per_dataset() -> Arranged:
    cells = _cells("main")
    parts = [
        (_cells_of(cells, dataset, r), "pecs", f"{dataset}_{r}", f"{TITLE_OF[dataset]}, {r[0].upper()}")
        for dataset in DATASETS
        for r in PRINTED_REGIMES
    ]
    return _wide(cells, ["model"], parts)


def _expanded(dataset: str, regime: str) -> Arranged:
    names = {field: SHARES[field] for field in ("acc_pct", "false_abs_pct", "abs_rec_pct", "pecs")}
    return _cells_of(_cells("main"), dataset, regime), [MODEL, *numbers(names)]


def _replication_per_dataset() -> Arranged:
    keys = [(m, d, r) for m in models_of(group="replication") for d in DATASETS for r in PRINTED_REGIMES]
    cells = _cells("replication").set_index(["model", "dataset", "regime"]).loc[keys].reset_index()
    return with_titles(cells), [MODEL, DATASET, COLUMNS["regime"], *numbers(SHARES)]


def _composition() -> Arranged:
    rows = as_printed("composition")
    rows["title"] = [f"{TITLE_OF[name]} (N = {SIZES[name]})" for name in rows["dataset"]]
    total = {"title": "Total", "label": "", "void_source": "", "n": "1,404", "question_type": ""}
    rows = pd.concat([rows, pd.DataFrame([total])], ignore_index=True)
    columns = [DATASET, Column("label", "Sub-scenario"), Column("void_source", "Void source"), *numbers({"n": "N"})]
    return rows, [*columns, Column("question_type", "Question type")]


def _probe_transfer() -> Arranged:
    pairs = titled_rows("probe_transfer")
    pairs["best_layer"] = "L" + pairs["best_layer"]
    words = {"best_layer": "layer", "auroc": "AUC", "auroc_confabulated": "Cf"}
    parts = [
        (pairs.loc[pairs["model"] == model], field, f"{model}_{field}", f"{model}, {word}")
        for model in STEERED
        for field, word in words.items()
    ]
    return _wide(pairs, ["transfer_type", "path"], parts)


def _probe_means() -> Arranged:
    means = as_printed("probe_means")
    means["both"] = means["auroc"] + " / " + means["auroc_confabulated"]
    parts = [(means.loc[means["model"] == model], "both", model, model) for model in STEERED]
    return _wide(means, ["transfer_type"], parts)


def _cosines() -> Arranged:
    rows = as_printed("cosine_qwen")
    order = [*dict.fromkeys(rows["source"])]
    rows["cosine"] = rows["cosine"].str.replace("-", "−")
    table_rows = rows.pivot(index="source", columns="other", values="cosine").loc[order].reset_index()
    return table_rows, [Column("source", "Direction"), *numbers({name: name for name in order})]


def _steering_regimes() -> Arranged:
    short_names = {"standard": "Std", "guided": "Gui", "oc": "Oc-family", "ch": "Ch-family"}
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for row in as_printed("steering_regime").to_dict("records"):
        family = str(row["direction_family"])
        first = short_names[row["direction_regime"] if family == "all" else family]
        second = short_names[row["inference_regime"]] if family == "all" else "guided inf."
        sides = [f"{row[f'{side}_alpha0']}→{row[f'{side}_alpha10']}" for side in ("control", "void")]
        rows.setdefault((first, second), {})[str(row["model"])] = " / ".join(sides)
    table = pd.DataFrame([{"directions": d, "inference": i, **cells} for (d, i), cells in rows.items()])
    names = {model: f"{model} ({layer})" for model, layer in STEERED.items()}
    return table, [Column("directions", "Dir."), Column("inference", "Inf."), *numbers(names)]


def _dose(family: str) -> Arranged:
    rows = titled_rows(f"steering_dose_{family}")
    # The first family's table alternates the sides at each alpha; the other has all controls first.
    order = [(letter, alpha) for alpha in ALPHAS for letter in SIDES]
    order = order if family == "qwen" else sorted(order, key=lambda pair: pair[0])
    parts = [
        (rows.loc[rows["alpha"] == alpha], SIDES[letter], f"{letter}{alpha}", f"{letter}, α {alpha}")
        for letter, alpha in order
    ]
    return _wide(rows, ["path"], parts)


_ARRANGED: Mapping[str, Callable[[], Arranged]] = {
    "overall": _overall,
    "per_dataset": _per_dataset,
    **{f"expanded_{dataset}_{r}": partial(_expanded, dataset, r) for dataset in DATASETS for r in PRINTED_REGIMES},
    "replication_per_dataset": _replication_per_dataset,
    "composition": _composition,
    "probe_transfer": _probe_transfer,
    "probe_means": _probe_means,
    "cosines": _cosines,
    "steering_regimes": _steering_regimes,
    **{f"steering_dose_{family}": partial(_dose, family) for family in ("qwen", "gemma")},
}


def arranged() -> dict[str, tuple[str, str]]:
    """Return the text of each table's file, and how `tables.csv` declares its columns, by the table's name."""
    return {name: _texts(*make()) for name, make in _ARRANGED.items()}


def _texts(rows: pd.DataFrame, columns: list[Column]) -> tuple[str, str]:
    declared = [column.field if COLUMNS.get(column.field) == column else _declared(column) for column in columns]
    fields = [*dict.fromkeys([*(column.field for column in columns), *rows])]  # those that are shown come first
    return rows[fields].to_csv(index=False), "; ".join(declared)


def _declared(column: Column) -> str:
    return f"{'#' if column.unit == 'range' else ''}{column.field}={column.heading}"
