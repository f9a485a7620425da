"""Show the paper's tables as printed (`assets/published`), without arithmetic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.tables.table_columns import DATASET, MODEL, with_titles
from traps_pipeline.report.terms import TITLES
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.analyses import models_of
from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd

SHARES = {"acc_pct": "Acc %", "abs_rec_pct": "AbsRec %", "false_abs_pct": "FalseAbs %", "pecs": "PECS"}
SPREADS = ("acc_std", "abs_rec_std", "false_abs_std", "pecs_std")
PRINTED_REGIMES = ("standard", "json", "guided")  # in the paper's order
SIZES = {"occlusion": "202", "occlusion_ill_posed": "202", "chaotic": "500", "chaotic_ill_posed": "500"}
STEERED = {"qwen3-vl-8b": "L20", "gemma-4-e4b": "L35", "llava-next-video-7b": "L28"}
ALPHAS = ("0", "2", "5", "10")
REGIME, SUB = Column("regime", "Regime", look="tag"), Column("sub_scenario", "Sub-scenario")
PATH, TYPE = Column("path", "Source → target"), Column("transfer_type", "Transfer type")


def paper_table(name: str, rows: pd.DataFrame, columns: Sequence[Column]) -> PrintedTable:
    """Return the paper's table `name`, with title, place and notes of `tables.csv`."""
    (table_row,) = as_printed("tables").query("name == @name").to_dict("records")
    source_note = f"as the paper prints it (line {table_row['line']} of its LaTeX source)"
    notes = [source_note, *([str(table_row["note"])] if table_row["note"] else [])]
    return PrintedTable(
        name, str(table_row["title"]), rows.reset_index(drop=True), columns, notes,
        dash="not given in the paper", deviation="± standard deviation over three runs",
    )  # fmt: skip


def figures(names: Mapping[str, str]) -> list[Column]:
    """Return columns of figures (field: heading), shown as the paper prints them."""
    return [Column(field, heading, "range") for field, heading in names.items()]


def in_text(card: str) -> list[PrintedTable]:
    """Return a table of this card's scores that only the paper's text states, if any."""
    rows = as_printed("other").query("card == @card")
    columns = [Column("model", "Model"), Column("quantity", "Quantity")]
    columns += figures({"printed": "Value", "line": "Line"})
    table = PrintedTable(f"{card}_text", "In the paper’s text", rows.reset_index(drop=True), columns)
    return [table] if len(rows) else []


# --- scores -----------------------------------------------------------------------------------------------------------


def overall() -> list[PrintedTable]:
    """Return all sixteen models under the three regimes."""
    rows = as_printed("overall")
    table_rows: pd.DataFrame = rows.loc[:, ["model"]].drop_duplicates()
    columns = [MODEL]
    for regime in PRINTED_REGIMES:
        names = {field: f"{regime}_{field}" for field in SHARES}
        part = rows.loc[rows["regime"] == regime, ["model", *names]]
        table_rows = table_rows.merge(part.rename(columns=names), on="model")
        columns += figures({names[field]: f"{heading}, {regime}" for field, heading in SHARES.items()})
    return [paper_table("overall", table_rows, columns)]


def replication_overall() -> list[PrintedTable]:
    """Return the two replication families, with one decimal."""
    return [paper_table("replication_overall", as_printed("replication_overall"), [MODEL, REGIME, *figures(SHARES)])]


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


def per_dataset() -> list[PrintedTable]:
    """Return PECS of the fourteen main-family models by dataset and regime."""
    cells = _cells("main")
    table_rows: pd.DataFrame = cells.loc[:, ["model"]].drop_duplicates()
    columns = [MODEL]
    for dataset in DATASETS:
        for regime in PRINTED_REGIMES:
            name = f"{dataset}_{regime}"
            part = _cells_of(cells, dataset, regime).loc[:, ["model", "pecs"]].rename(columns={"pecs": name})
            table_rows = table_rows.merge(part, on="model")
            columns += figures({name: f"{TITLES[dataset]}, {regime[0].upper()}"})
    return [paper_table("per_dataset", table_rows, columns)]


def expanded() -> list[PrintedTable]:
    """Return twelve tables, one for each dataset and regime."""
    cells = _cells("main")
    columns = [MODEL, *figures({field: SHARES[field] for field in ("acc_pct", "false_abs_pct", "abs_rec_pct", "pecs")})]
    keys = [(dataset, regime) for dataset in DATASETS for regime in PRINTED_REGIMES]
    return [paper_table(f"expanded_{'_'.join(key)}", _cells_of(cells, *key), columns) for key in keys]


def replication_per_dataset() -> list[PrintedTable]:
    """Return the two replication families on each dataset under each regime."""
    keys = [(m, d, r) for m in models_of(group="replication") for d in DATASETS for r in PRINTED_REGIMES]
    cells = with_titles(_cells("replication").set_index(["model", "dataset", "regime"]).loc[keys].reset_index())
    return [paper_table("replication_per_dataset", cells, [MODEL, DATASET, REGIME, *figures(SHARES)])]


def visual_textual() -> list[PrintedTable]:
    """Return AbsRec on visual and on textual voids, and their ratio, by taxonomy."""
    rows: pd.DataFrame = as_printed("visual_vs_textual")
    daggers = ["†" if epoch == "verification" else "" for epoch in rows["epoch"]]
    rows = rows.assign(model=rows["model"] + daggers)
    columns = [MODEL]
    for taxonomy in ("occlusion", "chaotic"):
        gap = f"{taxonomy}_gap"
        rows[gap] = ["∞" if text == "inf" else f"{text}×" for text in rows[gap]]
        kinds = {f"{taxonomy}_visual_pct": "Vis. %", f"{taxonomy}_textual_pct": "Text %", gap: "Gap"}
        columns += figures({field: f"{taxonomy.capitalize()}, {word}" for field, word in kinds.items()})
    return [paper_table("visual_textual", rows, columns)]


def naive() -> list[PrintedTable]:
    """Return the cells under guided in which Acc × AbsRec exceeds PECS most."""
    rows = as_printed("pecs_vs_naive")
    rows = with_titles(rows.assign(false_abs_pct=rows["false_abs_pct"] + "%"))
    names = {"naive": "Naive", "pecs": "PECS", "false_abs_pct": "FA"}
    return [paper_table("pecs_naive", rows, [MODEL, DATASET, *figures(names)])]


def degenerate() -> list[PrintedTable]:
    """Return six strategies whose PECS is 0, and why."""
    columns = figures({"acc": "Acc", "false_abs": "FA", "abs_rec": "AR", "j": "J"})
    columns = [Column("strategy", "Strategy"), *columns, Column("why", "Why PECS = 0")]
    return [paper_table("degenerate_strategies", as_printed("degenerate_strategies"), columns)]


def occlusion_sub_scenarios() -> list[PrintedTable]:
    """Return the fifteen occlusion sub-scenarios."""
    names = {"acc_pct": "Acc", "false_abs_pct": "FA", "abs_rec_pct": "AR", "guided_abs_rec_pct": "G-AR"}
    columns = [SUB, Column("answer_type", "Answer type"), *figures(names)]
    return [paper_table("occlusion_sub_scenarios", as_printed("occlusion_subscenarios"), columns)]


def chaotic_sub_scenarios() -> list[PrintedTable]:
    """Return the original three chaotic sub-scenarios, beside their uplift."""
    rows = as_printed("chaotic_subscenarios")
    names = {"acc_pct": "Acc", "false_abs_pct": "FA", "abs_rec_pct": "AR", "pecs": "PECS"}
    names |= {"abs_rec_ill_posed_pct": "AR, ill-posed"}
    columns = [SUB, *figures({"n": "N"}), Column("answer_type", "Answer type"), *figures(names)]
    uplift = {"abs_rec_pct": "Standard, AR", "false_abs_pct": "Standard, FA"}
    uplift |= {"guided_abs_rec_pct": "Guided, AR", "guided_false_abs_pct": "Guided, FA"}
    return [
        paper_table("chaotic_sub_scenarios", rows, columns),
        paper_table("chaotic_guided_uplift", rows, [SUB, *figures(uplift)]),
    ]


# --- setup and judges -------------------------------------------------------------------------------------------------


def models() -> list[PrintedTable]:
    """Return the sixteen models by the paper's names."""
    words = {"name": "Name", "type": "Type", "input": "Input", "notes": "Notes"}
    columns = [MODEL, *(Column(field, heading) for field, heading in words.items())]
    return [paper_table("models", as_printed("models"), columns)]


def composition() -> list[PrintedTable]:
    """Return scenes and questions by dataset, with the source of the void."""
    import pandas as pd

    rows = as_printed("composition")
    rows["title"] = [f"{TITLES[name]} (N = {SIZES[name]})" for name in rows["dataset"]]
    total = {"title": "Total", "label": "", "void_source": "", "n": "1,404", "question_type": ""}
    rows = pd.concat([rows, pd.DataFrame([total])], ignore_index=True)
    columns = [DATASET, Column("label", "Sub-scenario"), Column("void_source", "Void source"), *figures({"n": "N"})]
    return [paper_table("composition", rows, [*columns, Column("question_type", "Question type")])]


def hyperparameters() -> list[PrintedTable]:
    """Return the parameters that all models and all judges are sent."""
    columns = [Column("parameter", "Parameter"), *figures({"model_calls": "VLM calls", "judge_calls": "Judge calls"})]
    rows = as_printed("hyperparameters").replace({"judge_calls": {"": "–"}})
    return [paper_table("hyperparameters", rows, columns)]


def agreement() -> list[PrintedTable]:
    """Return unanimity and Fleiss' kappa by dataset and task."""
    rows = as_printed("judge_agreement")
    rows = with_titles(rows.assign(unanimous_pct=rows["unanimous_pct"] + "%"))
    columns = [DATASET, Column("task", "Judge task"), *figures({"unanimous_pct": "Unan.", "fleiss_kappa": "κ"})]
    return [paper_table("judge_agreement", rows, columns)]


def validation() -> list[PrintedTable]:
    """Return the confabulation judge against two annotators."""
    rows = as_printed("judge_validation")
    rows["human_kappa"] = [value or "–*" for value in rows["human_kappa"]]
    names = {"acc": "Acc", "precision": "Prec", "recall": "Rec", "f1": "F1"}
    names |= {"human_agree_pct": "% agree", "human_kappa": "Cohen’s κ"}
    return [paper_table("judge_validation", rows, [Column("category", "Category"), *figures(names)])]


def confabulation() -> list[PrintedTable]:
    """Return the prevalence of the four axes in six models."""
    rows = as_printed("confabulation_taxonomy")
    names = {"hp_pct": "HP", "ii_pct": "II", "hp_and_ii_pct": "HP∩II", "es_pct": "ES", "doubt_pct": "Doubt"}
    rows[[*names]] = rows[[*names]] + "%"
    rows["model"] = rows["model"] + ["†" if evidence == "trace" else "" for evidence in rows["doubt_read_from"]]
    return [paper_table("confabulation", rows, [MODEL, *figures({"n": "n", **names})])]


# --- probes, directions and steering ----------------------------------------------------------------------------------


def probes() -> list[PrintedTable]:
    """Return probe transfer of the three families by pair, and means by transfer type."""
    pairs = _paths(as_printed("probe_transfer"))
    pairs["best_layer"] = "L" + pairs["best_layer"]
    table_rows: pd.DataFrame = pairs.loc[:, ["transfer_type", "path"]].drop_duplicates()
    columns, words = [TYPE, PATH], {"best_layer": "layer", "auroc": "AUC", "auroc_confabulated": "Cf"}
    for model in STEERED:
        names = {f"{model}_{field}": f"{model}, {word}" for field, word in words.items()}
        part = pairs.query("model == @model").add_prefix(f"{model}_").rename(columns={f"{model}_path": "path"})
        table_rows = table_rows.merge(part[["path", *names]], on="path")
        columns += figures(names)
    means = as_printed("probe_means")
    means["both"] = means["auroc"] + " / " + means["auroc_confabulated"]
    means_by_type = means.pivot(index="transfer_type", columns="model", values="both")
    means_by_type = means_by_type.loc[[*dict.fromkeys(means["transfer_type"])]].reset_index()
    return [
        paper_table("probe_transfer", table_rows, columns),
        paper_table("probe_means", means_by_type, [TYPE, *figures({model: model for model in STEERED})]),
    ]


def cosines() -> list[PrintedTable]:
    """Return cosines of the directions of the first family."""
    rows = as_printed("cosine_qwen")
    order = [*dict.fromkeys(rows["source"])]
    rows["cosine"] = rows["cosine"].str.replace("-", "−")
    table_rows = rows.pivot(index="source", columns="other", values="cosine").loc[order].reset_index()
    columns = [Column("source", "Direction"), *figures({name: name for name in order})]
    return [paper_table("cosines", table_rows, columns)]


def steering() -> list[PrintedTable]:
    """Return steering by regime and family (alpha 10), by alpha, and by domain."""
    return [_regimes(), _top(), _domains(), _dose("qwen"), _dose("gemma")]


def _regimes() -> PrintedTable:
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
    columns = [Column("directions", "Dir."), Column("inference", "Inf."), *figures(names)]
    return paper_table("steering_regimes", table, columns)


def _top() -> PrintedTable:
    columns = [PATH, TYPE, *figures({"control_abstention_pct": "Ctrl ↑", "void_abstention_pct": "Void ↓"})]
    return paper_table("steering_top", _paths(as_printed("steering_alpha10_qwen")), columns)


def _domains() -> PrintedTable:
    rows = as_printed("same_domain_qwen")
    rows["target"] = "→ " + rows["same_target"] + " / → " + rows["cross_target"]
    shares = {"same_domain_pct": "Same-dom.", "cross_domain_pct": "Cross-dom."}
    rows[[*shares]] = rows[[*shares]] + "%"
    columns = [Column("direction", "Direction"), Column("target", "Target"), *figures(shares)]
    return paper_table("steering_domains", rows, columns)


def _dose(family: str) -> PrintedTable:
    rows = _paths(as_printed(f"steering_dose_{family}"))
    table_rows: pd.DataFrame = rows.loc[:, ["path"]].drop_duplicates()
    sides = {"C": "control_abstention_pct", "V": "void_abstention_pct"}
    # The first family's table alternates the sides at each alpha; the other has all controls first.
    order = [(letter, alpha) for alpha in ALPHAS for letter in sides]
    order = order if family == "qwen" else sorted(order, key=lambda pair: pair[0])
    for letter, alpha in order:
        part = rows.loc[rows["alpha"] == alpha, ["path", sides[letter]]]
        table_rows = table_rows.merge(part.rename(columns={sides[letter]: f"{letter}{alpha}"}), on="path")
    names = {f"{letter}{alpha}": f"{letter}, α {alpha}" for letter, alpha in order}
    return paper_table(f"steering_dose_{family}", table_rows, [PATH, *figures(names)])


def _paths(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.assign(path=rows["source"] + " → " + rows["target"])


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
