"""The paper's tables of its setup and its judges."""

from __future__ import annotations

from traps_pipeline.report.printed.printed_columns import figures, in_text, of_paper
from traps_pipeline.report.tables.table_columns import DATASET, MODEL, titled
from traps_pipeline.report.terms import TITLES
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.published import as_printed

SIZES = {"occlusion": "202", "occlusion_ill_posed": "202", "chaotic": "500", "chaotic_ill_posed": "500"}


def models() -> list[PrintedTable]:
    """Return the sixteen models by the paper's names."""
    words = {"name": "Name", "type": "Type", "input": "Input", "notes": "Notes"}
    columns = [MODEL, *(Column(field, heading) for field, heading in words.items())]
    return [of_paper("models", as_printed("models"), columns)]


def composition() -> list[PrintedTable]:
    """Return scenes and questions by dataset, with the source of the void."""
    import pandas as pd

    rows = as_printed("composition")
    rows["title"] = [f"{TITLES[name]} (N = {SIZES[name]})" for name in rows["dataset"]]
    total = {"title": "Total", "label": "", "void_source": "", "n": "1,404", "question_type": ""}
    rows = pd.concat([rows, pd.DataFrame([total])], ignore_index=True)
    columns = [
        DATASET, Column("label", "Sub-scenario"), Column("void_source", "Void source"),
        *figures({"n": "N"}), Column("question_type", "Question type"),
    ]  # fmt: skip
    return [of_paper("composition", rows, columns), *in_text("composition")]


def hyperparameters() -> list[PrintedTable]:
    """Return what all models and all judges are sent."""
    columns = [Column("parameter", "Parameter"), *figures({"model_calls": "VLM calls", "judge_calls": "Judge calls"})]
    rows = as_printed("hyperparameters").replace({"judge_calls": {"": "–"}})
    return [of_paper("hyperparameters", rows, columns)]


def agreement() -> list[PrintedTable]:
    """Return unanimity and Fleiss' kappa by dataset and task."""
    rows = as_printed("judge_agreement")
    rows = titled(rows.assign(unanimous_pct=rows["unanimous_pct"] + "%"))
    columns = [DATASET, Column("task", "Judge task")]
    columns += figures({"unanimous_pct": "Unan.", "fleiss_kappa": "κ"})
    return [of_paper("judge_agreement", rows, columns), *in_text("judge_agreement")]


def validation() -> list[PrintedTable]:
    """Return the confabulation judge against two annotators."""
    rows = as_printed("judge_validation")
    rows["human_kappa"] = [value or "–*" for value in rows["human_kappa"]]
    names = {
        "acc": "Acc", "precision": "Prec", "recall": "Rec", "f1": "F1", "human_agree_pct": "% agree",
        "human_kappa": "Cohen’s κ",
    }  # fmt: skip
    columns = [Column("category", "Category"), *figures(names)]
    return [of_paper("judge_validation", rows, columns), *in_text("judge_validation")]


def confabulation() -> list[PrintedTable]:
    """Return prevalence of the four axes in six models."""
    rows = as_printed("confabulation_taxonomy")
    names = {"hp_pct": "HP", "ii_pct": "II", "hp_and_ii_pct": "HP∩II", "es_pct": "ES", "doubt_pct": "Doubt"}
    rows[[*names]] = rows[[*names]] + "%"
    rows["model"] = rows["model"] + ["†" if where == "trace" else "" for where in rows["doubt_read_from"]]
    return [of_paper("confabulation", rows, [MODEL, *figures({"n": "n", **names})])]
