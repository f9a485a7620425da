"""The paper's tables of scores: leaderboards, datasets, gaps, sub-scenarios, robustness of PECS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.printed.printed_columns import figures, in_text, of_paper, with_spread
from traps_pipeline.report.tables.table_columns import DATASET, MODEL, titled
from traps_pipeline.report.terms import TITLES
from traps_pipeline.report.writing import Column, PrintedTable
from traps_pipeline.scoring.analyses import models_of
from traps_pipeline.scoring.published import as_printed

if TYPE_CHECKING:
    import pandas as pd

SHARES = {"acc_pct": "Acc %", "abs_rec_pct": "AbsRec %", "false_abs_pct": "FalseAbs %", "pecs": "PECS"}
SPREADS = ("acc_std", "abs_rec_std", "false_abs_std", "pecs_std")
PRINTED_REGIMES = ("standard", "json", "guided")  # in the paper's order
REGIME = Column("regime", "Regime", look="tag")


def overall() -> list[PrintedTable]:
    """Return all sixteen models under the three regimes."""
    rows = as_printed("overall")
    wide: pd.DataFrame = rows.loc[:, ["model"]].drop_duplicates()
    columns = [MODEL]
    for regime in PRINTED_REGIMES:
        names = {field: f"{regime}_{field}" for field in SHARES}
        part = rows.loc[rows["regime"] == regime, ["model", *names]]
        wide = wide.merge(part.rename(columns=names), on="model")
        columns += figures({names[field]: f"{heading}, {regime}" for field, heading in SHARES.items()})
    return [of_paper("overall", wide, columns)]


def replication_overall() -> list[PrintedTable]:
    """Return the two replication families, with one decimal."""
    return [of_paper("replication_overall", as_printed("replication_overall"), [MODEL, REGIME, *figures(SHARES)])]


def per_dataset() -> list[PrintedTable]:
    """Return PECS of the fourteen main-family models on each dataset under each regime."""
    cells = _cells("main")
    wide: pd.DataFrame = cells.loc[:, ["model"]].drop_duplicates()
    columns = [MODEL]
    for dataset in DATASETS:
        for regime in PRINTED_REGIMES:
            part = _of(cells, dataset, regime).loc[:, ["model", "pecs"]]
            name = f"{dataset}_{regime}"
            wide = wide.merge(part.rename(columns={"pecs": name}), on="model")
            columns += figures({name: f"{TITLES[dataset]}, {regime[0].upper()}"})
    return [of_paper("per_dataset", wide, columns)]


def expanded() -> list[PrintedTable]:
    """Return twelve tables, one for each dataset and regime."""
    cells = _cells("main")
    order = ("acc_pct", "false_abs_pct", "abs_rec_pct", "pecs")
    columns = [MODEL, *figures({field: SHARES[field] for field in order})]
    keys = [(dataset, regime) for dataset in DATASETS for regime in PRINTED_REGIMES]
    return [of_paper(f"expanded_{'_'.join(key)}", _of(cells, *key), columns) for key in keys]


def replication_per_dataset() -> list[PrintedTable]:
    """Return the two replication families on each dataset under each regime."""
    cells = _cells("replication")
    keys = [(m, d, r) for m in models_of(group="replication") for d in DATASETS for r in PRINTED_REGIMES]
    cells = titled(cells.set_index(["model", "dataset", "regime"]).loc[keys].reset_index())
    return [of_paper("replication_per_dataset", cells, [MODEL, DATASET, REGIME, *figures(SHARES)])]


def _of(cells: pd.DataFrame, dataset: str, regime: str) -> pd.DataFrame:
    return cells.loc[(cells["dataset"] == dataset) & (cells["regime"] == regime)]


def _cells(group: str) -> pd.DataFrame:
    cells = as_printed("behavioral_per_dataset")
    return with_spread(cells.loc[cells["model"].isin(models_of(group=group))], SHARES, SPREADS)


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
    return [of_paper("visual_textual", rows, columns), *in_text("visual_textual")]


def naive() -> list[PrintedTable]:
    """Return the cells under guided in which Acc × AbsRec exceeds PECS most."""
    rows = as_printed("pecs_vs_naive")
    rows = titled(rows.assign(false_abs_pct=rows["false_abs_pct"] + "%"))
    columns = [MODEL, DATASET, *figures({"naive": "Naive", "pecs": "PECS", "false_abs_pct": "FA"})]
    return [of_paper("pecs_naive", rows, columns), *in_text("pecs_naive")]


def degenerate() -> list[PrintedTable]:
    """Return six strategies whose PECS is 0, and why."""
    columns = figures({"acc": "Acc", "false_abs": "FA", "abs_rec": "AR", "j": "J"})
    columns = [Column("strategy", "Strategy"), *columns, Column("why", "Why PECS = 0")]
    return [of_paper("degenerate_strategies", as_printed("degenerate_strategies"), columns)]


def occlusion_sub_scenarios() -> list[PrintedTable]:
    """Return the fifteen occlusion sub-scenarios."""
    names = {"acc_pct": "Acc", "false_abs_pct": "FA", "abs_rec_pct": "AR", "guided_abs_rec_pct": "G-AR"}
    columns = [Column("sub_scenario", "Sub-scenario"), Column("answer_type", "Answer type"), *figures(names)]
    rows = as_printed("occlusion_subscenarios")
    return [of_paper("occlusion_sub_scenarios", rows, columns), *in_text("occlusion_sub_scenarios")]


def chaotic_sub_scenarios() -> list[PrintedTable]:
    """Return the three chaotic sub-scenarios of the original benchmark, and their uplift under guided."""
    rows = as_printed("chaotic_subscenarios")
    names = {
        "acc_pct": "Acc", "false_abs_pct": "FA", "abs_rec_pct": "AR", "pecs": "PECS",
        "abs_rec_ill_posed_pct": "AR, ill-posed",
    }  # fmt: skip
    name = Column("sub_scenario", "Sub-scenario")
    columns = [name, *figures({"n": "N"}), Column("answer_type", "Answer type"), *figures(names)]
    uplift = {
        "abs_rec_pct": "Standard, AR", "false_abs_pct": "Standard, FA",
        "guided_abs_rec_pct": "Guided, AR", "guided_false_abs_pct": "Guided, FA",
    }  # fmt: skip
    return [
        of_paper("chaotic_sub_scenarios", rows, columns),
        of_paper("chaotic_guided_uplift", rows, [name, *figures(uplift)]),
        *in_text("chaotic_sub_scenarios"),
    ]


def guided_uplift() -> list[PrintedTable]:
    """Return what the text says of AbsRec under guided against standard."""
    return in_text("guided_uplift")


def zero_boundary() -> list[PrintedTable]:
    """Return what the text says of cells with PECS 0."""
    return in_text("zero_boundary")


def run_spread() -> list[PrintedTable]:
    """Return what the text says of the spread over runs."""
    return in_text("run_spread")
