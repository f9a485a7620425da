"""Show the paper's tables as printed (`assets/published`), without arithmetic.

`tables.csv` gives each table's card, file and columns. A column is `FIELD=HEADING`, or a field of `_COLUMNS`; `#` in
front of the field says that it is a figure, a `%` or `×` behind it is printed after each value, and `|TEXT` in place of
an empty one. A table without a file is arranged by a function of `_ARRANGED`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.tables.table_columns import DATASET, MODEL, with_titles
from traps_pipeline.report.terms import TITLES
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.analyses import models_of
from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd

    Arranged = tuple[pd.DataFrame, list[Column]]

SHARES = {"acc_pct": "Acc %", "abs_rec_pct": "AbsRec %", "false_abs_pct": "FalseAbs %", "pecs": "PECS"}
SPREADS = ("acc_std", "abs_rec_std", "false_abs_std", "pecs_std")
PRINTED_REGIMES = ("standard", "json", "guided")  # in the paper's order
SIZES = {"occlusion": "202", "occlusion_ill_posed": "202", "chaotic": "500", "chaotic_ill_posed": "500"}
STEERED = {"qwen3-vl-8b": "L20", "gemma-4-e4b": "L35", "llava-next-video-7b": "L28"}
ALPHAS = ("0", "2", "5", "10")
SIDES = {"C": "control_abstention_pct", "V": "void_abstention_pct"}
_COLUMNS = {
    column.field: column
    for column in (
        *(MODEL, DATASET, Column("regime", "Regime", look="tag"), Column("sub_scenario", "Sub-scenario")),
        *(Column("path", "Source → target"), Column("transfer_type", "Transfer type")),
    )
}
_DECLARED = re.compile(r"(?P<figure>#?)(?P<field>\w+)(?P<unit>[%×]?)(?:\|(?P<empty>[^=]+))?(?:=(?P<heading>.+))?")
# The rows whose model is marked, since they are of another evaluation or read from other evidence.
_DAGGERS = {"visual_vs_textual": ("epoch", "verification"), "confabulation_taxonomy": ("doubt_read_from", "trace")}


def paper_tables(card: str) -> list[PrintedTable]:
    """Return the paper's tables of a card, and its scores that only the paper's text states, if any."""
    tables = [_paper_table(place) for place in as_printed("tables").query("card == @card").to_dict("records")]
    rows = as_printed("other").query("card == @card").reset_index(drop=True)
    columns = [Column("model", "Model"), Column("quantity", "Quantity")]
    columns += figures({"printed": "Value", "line": "Line"})
    return [*tables, *([PrintedTable(f"{card}_text", "In the paper’s text", rows, columns)] if len(rows) else [])]


def _paper_table(place: Mapping[Any, str]) -> PrintedTable:
    """Return the table of a row of `tables.csv`."""
    rows, columns = _as_declared(place["file"], place["columns"]) if place["file"] else _ARRANGED[place["name"]]()
    notes = [f"as the paper prints it (line {place['line']} of its LaTeX source)", *filter(None, [place["note"]])]
    return PrintedTable(
        place["name"], place["title"], rows.reset_index(drop=True), columns, notes,
        dash="not given in the paper", deviation="± standard deviation over three runs",
    )  # fmt: skip


def _as_declared(file: str, declared: str) -> Arranged:
    """Return a file's rows as printed, and their columns."""
    rows, columns = _rows(file), list[Column]()
    for text in declared.split("; "):
        found = _DECLARED.fullmatch(text)
        assert found, f"tables.csv: {text!r} declares no column"
        field, unit, empty = found["field"], found["unit"], found["empty"] or ""
        rows[field] = ["∞" if value == "inf" else value + unit if value else empty for value in rows[field]]
        kind = "range" if found["figure"] else "text"
        columns.append(Column(field, found["heading"], kind) if found["heading"] else _COLUMNS[field])
    return rows, columns


def _rows(file: str) -> pd.DataFrame:
    """Return a file's rows with the titles of datasets, paths of directions and daggers."""
    rows: pd.DataFrame = as_printed(file)
    if "dataset" in rows:
        rows = with_titles(rows)
    if {"source", "target"} <= {*rows}:
        rows = rows.assign(path=rows["source"] + " → " + rows["target"])
    if "same_target" in rows:
        rows = rows.assign(target="→ " + rows["same_target"] + " / → " + rows["cross_target"])
    if file in _DAGGERS:
        column, marked = _DAGGERS[file]
        rows["model"] = rows["model"] + ["†" if value == marked else "" for value in rows[column]]
    return rows


def figures(names: Mapping[str, str]) -> list[Column]:
    """Return columns of figures (field: heading), shown as the paper prints them."""
    return [Column(field, heading, "range") for field, heading in names.items()]


def _wide(rows: pd.DataFrame, kept: list[str], parts: Iterable[tuple[pd.DataFrame, str, str, str]]) -> Arranged:
    """Return a row for each value of the last column kept, and a column for each part of the rows.

    parts: rows, field, name of the column and heading.
    """
    table = rows.loc[:, kept].drop_duplicates(ignore_index=True)
    columns = [_COLUMNS[name] for name in kept]
    for part, field, name, heading in parts:
        table[name] = table[kept[-1]].map(part.set_index(kept[-1])[field])
        columns += figures({name: heading})
    return table, columns


# --- arranged tables --------------------------------------------------------------------------------------------------


def _overall() -> Arranged:
    rows = as_printed("overall")
    parts = [
        (rows.loc[rows["regime"] == regime], field, f"{regime}_{field}", f"{heading}, {regime}")
        for regime in PRINTED_REGIMES
        for field, heading in SHARES.items()
    ]
    return _wide(rows, ["model"], parts)


def _cells(group: str) -> pd.DataFrame:
    """Return the cells of a group's models, `figure ± spread` where both are printed."""
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
        (_cells_of(cells, dataset, r), "pecs", f"{dataset}_{r}", f"{TITLES[dataset]}, {r[0].upper()}")
        for dataset in DATASETS
        for r in PRINTED_REGIMES
    ]
    return _wide(cells, ["model"], parts)


def _expanded(dataset: str, regime: str) -> Arranged:
    names = {field: SHARES[field] for field in ("acc_pct", "false_abs_pct", "abs_rec_pct", "pecs")}
    return _cells_of(_cells("main"), dataset, regime), [MODEL, *figures(names)]


def _replication_per_dataset() -> Arranged:
    keys = [(m, d, r) for m in models_of(group="replication") for d in DATASETS for r in PRINTED_REGIMES]
    cells = _cells("replication").set_index(["model", "dataset", "regime"]).loc[keys].reset_index()
    return with_titles(cells), [MODEL, DATASET, _COLUMNS["regime"], *figures(SHARES)]


def _composition() -> Arranged:
    import pandas as pd

    rows = as_printed("composition")
    rows["title"] = [f"{TITLES[name]} (N = {SIZES[name]})" for name in rows["dataset"]]
    total = {"title": "Total", "label": "", "void_source": "", "n": "1,404", "question_type": ""}
    rows = pd.concat([rows, pd.DataFrame([total])], ignore_index=True)
    columns = [DATASET, Column("label", "Sub-scenario"), Column("void_source", "Void source"), *figures({"n": "N"})]
    return rows, [*columns, Column("question_type", "Question type")]


def _probe_transfer() -> Arranged:
    pairs = _rows("probe_transfer")
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
    return table_rows, [Column("source", "Direction"), *figures({name: name for name in order})]


def _steering_regimes() -> Arranged:
    import pandas as pd

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
    return table, [Column("directions", "Dir."), Column("inference", "Inf."), *figures(names)]


def _dose(family: str) -> Arranged:
    rows = _rows(f"steering_dose_{family}")
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


@cache
def audit_table() -> PrintedTable:
    """Return statements that differ from the paper's tables, with line and arithmetic."""
    from traps_pipeline.scoring.audit import DECLARED, DIFFERS, audit, counts_text  # pandas takes long to import

    findings = audit()
    rows = findings.loc[findings["verdict"].isin([DIFFERS, DECLARED])].reset_index(drop=True)
    columns = [
        Column("line", "Line"), Column("group", "Group"), Column("statement", "Statement"),
        Column("published", "Published"), Column("recomputed", "Recomputed, or elsewhere"),
        Column("verdict", "Verdict"), Column("reason", "Why"),
    ]  # fmt: skip
    return PrintedTable(
        "audit", "Statements that the paper’s tables do not give", rows, columns, [counts_text(findings)]
    )
