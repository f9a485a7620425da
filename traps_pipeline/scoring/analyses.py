"""Compute the paper's analyses, from cells to a tidy frame (docs/spec.md 5.4).

`cells` has one row per (model, dataset, regime), averaged over runs, with the columns model, dataset, regime, acc,
abs_rec, false_abs, pecs (fractions) and epoch; `study_cells` makes it from a study, `published.published_cells` from
the paper. The input may hold further columns and is never changed. A ratio or gap whose two sides are of different
epochs raises `epochs.EpochMismatch`; a mean over datasets takes each dataset in its own epoch, the same on both sides.
A mean is null if one of its values is null. A mean over models uses the models that have every metric it needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import GUIDED, PROMPTING, STANDARD
from traps_pipeline.scoring.epochs import require_one_epoch
from traps_pipeline.scoring.metrics import joined_epochs, joined_in_groups

if TYPE_CHECKING:
    import pandas as pd
    from pandas.api.typing import DataFrameGroupBy

SHARES = ["acc", "abs_rec", "false_abs", "pecs"]
TAXONOMIES = ("occlusion", "chaotic")
# The thinking member first (docs/spec.md 5.4).
REASONING_PAIRS = (
    ("gemini-2.5-flash", "gemini-2.5-flash-nt"),
    ("gemini-3.1-pro", "gemini-3.1-pro-r-low"),
    ("qwen3-vl-think", "qwen3-vl-instruct"),
)
REASONING_LADDER = ("gpt-5-nr", "gpt-5-medium", "gpt-5-high", "gpt-5-pro")
HIDDEN_SUB_SCENARIOS = ("hidden_collision", "hidden_drop", "hidden_race")
_ENTRY = ["model", "dataset", "regime"]
_EQUAL = 12  # decimals at which two means count as equal: below any printed digit, above rounding noise


# --- cells ------------------------------------------------------------------------------------------------------------


def study_cells(leaderboard: pd.DataFrame) -> pd.DataFrame:
    """Return the datasets' rows of LEADERBOARD: shares with deviations over runs (`_std`), and counts."""
    rows = null_single_deviations(leaderboard.loc[leaderboard["dataset"] != "overall"])
    spread = [f"{share}_std" for share in SHARES]
    columns = [*_ENTRY, "epoch", "n_pairs", "n_runs", "n_missing", "incomplete", *SHARES, *spread]
    return rows.loc[:, columns].reset_index(drop=True)


def null_single_deviations(rows: pd.DataFrame) -> pd.DataFrame:
    """Set standard deviations to null in rows that rest on a single run."""
    spreads = [name for name in rows if name.endswith("_std")]
    return rows.assign(**{name: rows[name].where(rows["n_runs"] > 1) for name in spreads})


def scoped_cells(metrics: pd.DataFrame, scope: str) -> pd.DataFrame:
    """Return the metrics of parts of a dataset, averaged over runs, from METRICS rows.

    scope: `category`, `sub_scenario` or `label` (the control's answer in a sub-scenario). Columns as in `study_cells`,
    and `scope`, which names the part.
    """
    from traps_pipeline.scoring.standings import group_metric

    parts = metrics["scope"].str.partition(":")
    rows = metrics.assign(scope=parts[2]).loc[parts[0] == scope]
    groups = rows.groupby([*_ENTRY, "scope"], sort=True)
    cells = group_metric(groups, SHARES)
    cells["n_pairs"], cells["n_missing"] = groups["n_pairs"].max(), groups["n_missing"].sum()
    cells["n_runs"], cells["epoch"] = groups["run"].nunique(), joined_in_groups(groups, "epoch", joined_epochs)
    return cells.reset_index()


def models_of(group: str | None = None, family: str | None = None, media: str | None = None) -> list[str]:
    """Return ids of the registry's models by group (main, ..), family and input media."""
    criteria = {"group": group, "family": family, "input": media}
    return [
        entry.id
        for entry in load_models().values()
        if all(value is None or getattr(entry.groups, name) == value for name, value in criteria.items())
    ]


# --- means ------------------------------------------------------------------------------------------------------------


def overall(cells: pd.DataFrame) -> pd.DataFrame:
    """Return equal-weight means over datasets, a row per (model, regime).

    Columns: model, regime, acc, abs_rec, false_abs, pecs. PECS is averaged too, not recomputed from the means. A
    (model, regime) that lacks one of the datasets in `cells` has no row, so that all rows average the same datasets.
    """
    cells = _check(cells)
    groups = cells.groupby(["model", "regime"], sort=False)
    complete_runs = cells.loc[groups["dataset"].transform("nunique") == cells["dataset"].nunique()]
    return _means(complete_runs.groupby(["model", "regime"], sort=False), SHARES).reset_index()


def uplift(cells: pd.DataFrame, means: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return mean AbsRec under guided over that under standard: columns model, ratio.

    There is one row per model that has both regimes. means: a study's own `overall` rows, which leave out runs without
    all datasets; by default the means of `cells`. The ratio is infinite where standard is 0 and guided is not, and null
    where either is null.
    """
    import pandas as pd

    cells = _check(cells)
    cells = cells.loc[cells["regime"].isin(PROMPTING)]
    require_one_epoch(cells.pivot(index=["model", "dataset"], columns="regime", values="epoch"), "uplift")
    rows = overall(cells) if means is None else means
    guided, standard = (rows[rows["regime"] == r].set_index("model")["abs_rec"] for r in (GUIDED, STANDARD))
    models = [model for model in rows["model"].unique() if model in guided.index and model in standard.index]
    return pd.DataFrame({"model": models, "ratio": divide_elementwise(guided.loc[models], standard.loc[models])})


def spread(cells: pd.DataFrame, column: str = "pecs_std") -> pd.DataFrame:
    """Return quartiles of deviations over runs, over all cells: q25, median, q75, n.

    Cells with a single run have no deviation and are left out. The paper does not say which metric its quartiles
    describe; the default is PECS.
    """
    import pandas as pd

    values = cells[column].dropna().to_numpy(float)
    q25, median, q75 = np.quantile(values, [0.25, 0.5, 0.75]) if len(values) else (np.nan,) * 3
    return pd.DataFrame({"q25": [q25], "median": [median], "q75": [q75], "n": [len(values)]})


# --- PECS and its limits ----------------------------------------------------------------------------------------------


def frontier(means: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that no other row dominates in acc and j within a regime, by decreasing Acc.

    A model dominates another if it is at least as good in both metrics and better in one. Two equal models are both on
    the frontier; a model without Acc or J is not on it.
    """
    import pandas as pd

    means = means.dropna(subset=["acc", "j"])
    best = [group.loc[~_is_dominated(group)] for _, group in means.groupby("regime", sort=False)]
    points = pd.DataFrame(pd.concat(best or [means]))
    return points.sort_values(["regime", "acc"], ascending=[True, False], ignore_index=True)


def _is_dominated(points: pd.DataFrame) -> np.ndarray:
    """Return which rows another row dominates in (acc, j): (rows,) bool."""
    values = points[["acc", "j"]].round(_EQUAL).to_numpy(float)
    no_worse = (values[None] >= values[:, None]).all(-1)  # [i, k]: k is no worse than i in both
    better = (values[None] > values[:, None]).any(-1)
    return np.any(no_worse & better, axis=1)


def naive_gap(cells: pd.DataFrame, threshold: float = 0.03) -> pd.DataFrame:
    """Return cells whose naive (Acc x AbsRec) exceeds PECS by a gap above `threshold`."""
    cells = _check(cells)
    cells["naive"] = cells["acc"] * cells["abs_rec"]
    cells["gap"] = cells["naive"] - cells["pecs"]
    return cells.loc[cells["gap"].round(_EQUAL) > threshold].reset_index(drop=True)


def zero_boundary(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the cells with PECS 0, in which no run has both Acc and J above 0."""
    cells = _check(cells)
    return cells.loc[cells["pecs"] == 0].reset_index(drop=True)


def degenerate_strategies() -> pd.DataFrame:
    """Return a frame of the expected metrics of strategies that do not discriminate.

    Columns strategy, acc, false_abs, abs_rec, j, pecs, naive. acc is null where the strategy does not determine it;
    PECS is still 0, since J is not above 0.
    """
    import pandas as pd

    share = 0.2  # an arbitrary share: it is the same on both sides
    rows = [
        ("always-abstain", 0.0, 1.0, 1.0),
        ("never-abstain", np.nan, 0.0, 0.0),
        ("random-50", np.nan, 0.5, 0.5),
        ("perfect-answerer", 1.0, 0.0, 0.0),
        ("inverse-oracle", 0.0, 1.0, 0.0),
        ("confidence-noise", np.nan, share, share),
    ]
    table = pd.DataFrame(rows, columns=pd.Index(["strategy", "acc", "false_abs", "abs_rec"]))
    table["j"] = table["abs_rec"] - table["false_abs"]
    # An Acc of at most 1 bounds PECS by max(0, J), which is 0 for all of them.
    table["pecs"] = np.maximum(table["j"], 0.0) * table["acc"].fillna(1.0)
    return table.assign(naive=np.where(table["abs_rec"] == 0, 0.0, table["acc"] * table["abs_rec"]))


# --- comparisons within a model or a pair -----------------------------------------------------------------------------


def visual_textual_gap(cells: pd.DataFrame, taxonomies: Sequence[str] = TAXONOMIES) -> pd.DataFrame:
    """Return textual over visual AbsRec, by model, regime and taxonomy.

    Columns: model, regime, taxonomy, visual, textual, gap. taxonomy: occlusion, chaotic or pooled. Visual is the AbsRec
    on the taxonomy's own dataset, textual that on its ill-posed one. `pooled` is the mean of the two textual values
    over the mean of the two visual ones, if both taxonomies are in `cells`. The gap is infinite where visual is 0 and
    textual is not, and null where both are 0. Raises EpochMismatch if the two datasets of a taxonomy are of different
    epochs, like the paper's own chaotic datasets, whose gaps it prints from an earlier epoch (`visual_vs_textual.csv`).
    """
    import pandas as pd

    cells = _check(cells)
    sides = cells.assign(
        taxonomy=cells["dataset"].str.removesuffix("_ill_posed"),
        side=np.where(cells["dataset"].str.endswith("_ill_posed"), "textual", "visual"),
    )
    sides = sides.loc[sides["taxonomy"].isin(list(taxonomies))]
    index = ["model", "regime", "taxonomy"]
    require_one_epoch(sides.pivot(index=index, columns="side", values="epoch"), "visual against textual")
    rates = sides.pivot(index=index, columns="side", values="abs_rec").reindex(columns=["visual", "textual"]).dropna()
    pooled = rates.groupby(level=["model", "regime"]).filter(lambda group: len(group) == len(TAXONOMIES))
    means = pd.DataFrame(pooled.groupby(level=["model", "regime"]).mean())
    pooled = means.assign(taxonomy="pooled").reset_index()
    table = pd.concat([rates.reset_index(), pooled], ignore_index=True)
    table["gap"] = divide_elementwise(table["textual"], table["visual"])
    models, places = list(cells["model"].unique()), (*TAXONOMIES, "pooled")
    keys = zip(table["regime"], table["model"], table["taxonomy"], strict=True)
    order = [(regime, models.index(model), places.index(taxonomy)) for regime, model, taxonomy in keys]
    rows = sorted(range(len(table)), key=order.__getitem__)
    return table.iloc[rows][[*index, "visual", "textual", "gap"]].reset_index(drop=True)


def pair_differences(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the thinking member of each pair minus the other, by regime and dataset.

    Columns thinking, other, regime, dataset, acc, abs_rec, false_abs, pecs (differences of fractions). The cells may
    include the dataset `overall`.
    """
    import pandas as pd

    cells = _check(cells, datasets=(*DATASETS, "overall"))
    indexed_cells = cells.set_index(_ENTRY)
    rows = []
    for thinking, other in REASONING_PAIRS:
        if not {thinking, other} <= set(cells["model"]):
            continue
        sides = {name: indexed_cells.loc[name] for name in (thinking, other)}
        epochs = pd.DataFrame({name: side["epoch"] for name, side in sides.items()}).dropna()
        require_one_epoch(epochs, f"{thinking} against {other}")
        change = (sides[thinking][SHARES] - sides[other][SHARES]).loc[epochs.index].reset_index()
        rows.append(change.assign(thinking=thinking, other=other))
    columns = ["thinking", "other", "regime", "dataset", *SHARES]
    return pd.concat(rows, ignore_index=True).loc[:, columns] if rows else pd.DataFrame(columns=pd.Index(columns))


# --- sub-scenarios ----------------------------------------------------------------------------------------------------


def sub_scenarios(cells: pd.DataFrame) -> pd.DataFrame:
    """Return means over models for every sub-scenario of the visual datasets.

    cells: `scoped_cells(metrics, "sub_scenario")`. Columns: dataset, sub_scenario, n_pairs; acc, false_abs, abs_rec,
    pecs under standard, over n_models models; these with the prefix guided_, over guided_n_models; abs_rec_uplift and
    false_abs_uplift (guided minus standard), over the uplift_n_models that have both; abs_rec_ill_posed (standard) and
    textual_over_visual, over the ill_posed_n_models that have both; n_missing, the missing items of all cells used. A
    model with a null metric is left out of the group of means that needs it. A mean is null if its regime or dataset
    was not run.
    """
    import pandas as pd

    cells = _check(cells, more=["scope"])
    rows = []
    for key, group in cells.groupby([cells["dataset"].str.removesuffix("_ill_posed"), "scope"]):
        taxonomy, scope = cast(tuple[str, str], key)
        visual, textual = group.loc[group["dataset"] == taxonomy], group.loc[group["dataset"] != taxonomy]
        regime_rows = {r: visual.loc[visual["regime"] == r].set_index("model") for r in PROMPTING}
        standard, guided = (regime_rows[r].dropna(subset=SHARES) for r in PROMPTING)
        textual_voids = textual.loc[textual["regime"] == "standard"].set_index("model").dropna(subset=["abs_rec"])
        epochs = pd.DataFrame(
            {"standard": standard["epoch"], "guided": guided["epoch"], "ill-posed": textual_voids["epoch"]}
        )
        require_one_epoch(epochs, f"sub-scenario {scope} of {taxonomy}")
        guided_models, common = (standard.index.intersection(side.index) for side in (guided, textual_voids))
        change = (guided.loc[guided_models, SHARES] - standard.loc[guided_models, SHARES]).mean()
        row = {"dataset": taxonomy, "sub_scenario": scope, "n_pairs": visual["n_pairs"].max()}
        row |= {"n_models": len(standard)} | standard[SHARES].mean().to_dict()
        row |= {
            "guided_n_models": len(guided),
            "uplift_n_models": len(guided_models),
            "ill_posed_n_models": len(common),
        }
        row |= guided[SHARES].mean().add_prefix("guided_").to_dict()
        row |= {f"{share}_uplift": change[share] for share in ("abs_rec", "false_abs")}
        means = [pd.Series([side.loc[common, "abs_rec"].mean()]) for side in (textual_voids, standard)]
        row |= {"abs_rec_ill_posed": means[0][0], "textual_over_visual": float(divide_elementwise(*means)[0])}
        row["n_missing"] = sum(int(side["n_missing"].sum()) for side in (standard, guided, textual_voids.loc[common]))
        rows.append(row)
    return pd.DataFrame(rows)


def hidden_against_others(table: pd.DataFrame, columns: Sequence[str] = ("abs_rec", "guided_abs_rec")) -> pd.DataFrame:
    """Return unweighted means over the hidden sub-scenarios and over the others.

    Columns kind, n, and `columns`; n_pairs and n_missing are sums, if table has them. table has one row per occlusion
    sub-scenario with the column sub_scenario, as `sub_scenarios` returns it.
    """
    kind = np.where(table["sub_scenario"].isin(HIDDEN_SUB_SCENARIOS), "hidden", "other")
    groups = table.groupby(kind)
    sums = {name: groups[name].sum(min_count=1) for name in ("n_pairs", "n_missing") if name in table}
    return _means(groups, columns).assign(n=groups.size(), **sums).rename_axis("kind").reset_index()


def accuracy_by_label(cells: pd.DataFrame) -> pd.DataFrame:
    """Return mean Acc (standard) by the control's answer, over models that have it.

    cells: `scoped_cells(metrics, "label")`. Columns dataset, sub_scenario, label, acc, n_pairs, n_models, n_missing
    (items of both sides, over these models).
    """
    import pandas as pd

    rows = _check(cells, more=["scope"])
    groups = rows.loc[rows["regime"] == "standard"].dropna(subset=["acc"]).groupby(["dataset", "scope"])
    columns = {"acc": groups["acc"].mean(), "n_pairs": groups["n_pairs"].max(), "n_models": groups["model"].nunique()}
    table = pd.DataFrame(columns | {"n_missing": groups["n_missing"].sum()})
    table = table.reset_index()
    parts = [str(scope).partition("/") for scope in table["scope"]]
    return table.assign(sub_scenario=[p[0] for p in parts], label=[p[2] for p in parts]).drop(columns="scope")


# --- helpers ----------------------------------------------------------------------------------------------------------


def divide_elementwise(numerator: pd.Series | pd.DataFrame, denominator: pd.Series | pd.DataFrame) -> np.ndarray:
    """Return the quotients as an array: infinite where the denominator is 0, NaN where both are."""
    top, bottom = numerator.to_numpy(float), denominator.to_numpy(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return top / bottom


def _means(groups: DataFrameGroupBy, columns: Sequence[str]) -> pd.DataFrame:
    """Return means of columns of a pandas groupby, null where any value is."""
    import pandas as pd

    values = groups[list(columns)]
    means, counts = pd.DataFrame(values.mean()), pd.DataFrame(values.count())
    return means.where(counts.eq(groups.size(), axis="index"))


def _check(cells: pd.DataFrame, more: Sequence[str] = (), datasets: Sequence[str] = DATASETS) -> pd.DataFrame:
    """Return a copy of cells. Raises ValueError for lacking columns or repeated rows."""
    missing = [name for name in (*_ENTRY, *SHARES, "epoch", *more) if name not in cells]
    if missing:
        raise ValueError(f"cells lack the columns {missing}")
    repeated_cells = cells.loc[cells.duplicated([*_ENTRY, *more])]
    if len(repeated_cells):
        first = repeated_cells.iloc[0]
        raise ValueError(
            f"cells have two rows for {first['model']}, {first['dataset']}, {first['regime']}: average runs first"
        )
    unknown = sorted(set(cells["dataset"]) - set(datasets))
    if unknown:
        raise ValueError(f"cells of unknown datasets {unknown}; known: {', '.join(datasets)}")
    return cells.reset_index(drop=True)
