"""Compute every statement in `claims.csv` from published tables, for `audit`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import fmean, median
from typing import Any

import pandas as pd

from tools.paper_audit.claims_mechanism import MECHANISM, Recomputed, text_figure
from traps_pipeline.models.registry.entries import load_models
from traps_pipeline.protocol.regimes import GUIDED, PAPER_REGIMES
from traps_pipeline.scoring.analyses import (
    hidden_against_others,
    models_of,
    naive_gap,
    pareto_frontier,
    spread,
    uplift,
    zero_boundary,
)
from traps_pipeline.scoring.published import published, published_cells, published_overall, published_rows


def _best(regime: str) -> Recomputed:
    rows = published_overall().query("regime == @regime")
    best = rows.loc[rows["pecs"].idxmax()]
    return Recomputed(f"{best['model']} {best['pecs']:.3f}")


def _uplifts(models: Sequence[str]) -> pd.Series:
    cells = published_cells()
    return uplift(cells).set_index("model")["ratio"].loc[list(models)]


def _video_native() -> list[str]:
    return models_of("main", media="video")


def _frontier() -> Recomputed:
    cells = published_cells()
    frontier = pareto_frontier(cells.loc[cells["regime"] == GUIDED])
    return Recomputed("; ".join(sorted(frontier["model"])))


def _main_cells(regime: str) -> pd.DataFrame:
    cells = published_cells()
    return cells.loc[cells["model"].isin(models_of("main")) & (cells["regime"] == regime)]


def _naive_gap() -> Recomputed:
    cells = _main_cells("guided")
    return Recomputed(f"{len(naive_gap(cells, 0.03))} of {len(cells)}")


def _zeros(regime: str) -> Recomputed:
    cells = _main_cells(regime)
    zero_cells = zero_boundary(cells)
    cell = f" ({' '.join(zero_cells.iloc[0][['model', 'dataset']])})" if len(zero_cells) == 1 else ""
    return Recomputed(f"{len(zero_cells)} of {len(cells)}{cell}")


def _spread(models: Sequence[str]) -> Recomputed:
    cells = published_cells()
    model_cells = cells.loc[cells["model"].isin(models)]
    row = spread(model_cells).iloc[0]
    quartiles = [f"{name} {r.q25:.4f}-{r.q75:.4f}" for name, r in _spreads_of_shares(model_cells)]
    return Recomputed(
        f"{row['q25']:.4f} to {row['q75']:.4f}",
        f"quartiles over the {int(row['n'])} cells with a spread; other metrics give {', '.join(quartiles)}, and PECS "
        f"on each dataset {', '.join(_dataset_spreads(model_cells))}: the published selection of cells is not stated",
    )


def _spreads_of_shares(cells: pd.DataFrame) -> Iterator[tuple[str, pd.Series]]:
    for share in ("acc", "abs_rec", "false_abs"):
        yield share, spread(cells, f"{share}_std").iloc[0]


def _dataset_spreads(cells: pd.DataFrame) -> Iterator[str]:
    for dataset, part in cells.groupby("dataset", sort=False):
        row = spread(part).iloc[0]
        yield f"{dataset} {row['q25']:.4f}-{row['q75']:.4f}"


def _chaotic_gaps() -> Recomputed:
    rows = published("visual_vs_textual").set_index("model").loc[_video_native()]
    gap = rows["chaotic_textual_pct"] / rows["chaotic_visual_pct"]
    return Recomputed(f"{gap.min():.2f} to {gap.max():.2f}")


def _textual_above() -> Recomputed:
    rows = published("visual_vs_textual")
    textual, visual = (rows[[f"occlusion_{k}_pct", f"chaotic_{k}_pct"]].mean(axis=1) for k in ("textual", "visual"))
    return Recomputed(f"{int((textual > visual).sum())} of {len(rows)}")


def _think_qwen() -> Recomputed:
    cells = published("behavioral_per_dataset").query("dataset == 'chaotic_ill_posed' and regime == 'standard'")
    rates = cells.set_index("model")["abs_rec_pct"]
    return Recomputed(f"{rates['qwen3-vl-instruct']:.1f} and {rates['qwen3-vl-think']:.1f}")


def _range(name: str, column: str, decimals: int, models: Sequence[str] | None = None) -> Recomputed:
    rows = published(name)
    values = rows[column] if models is None else rows.set_index("model").loc[list(models), column]
    return Recomputed(f"{values.min():.{decimals}f} to {values.max():.{decimals}f}")


def _mean(name: str, column: str, scale: float) -> Recomputed:
    return Recomputed(f"{published(name)[column].mean() * scale:g}")


def _hidden(column: str) -> Recomputed:
    means = hidden_against_others(published("occlusion_subscenarios"), [column]).set_index("kind")[column]
    return Recomputed(f"{means['hidden']:.4f} and {means['other']:.4f}")


def _flash_thinking() -> Recomputed:
    rows = published("visual_vs_textual").set_index("model")
    rates = [f"{taxonomy}_{kind}_pct" for taxonomy in ("occlusion", "chaotic") for kind in ("visual", "textual")]
    change = rows.loc["gemini-2.5-flash", rates] - rows.loc["gemini-2.5-flash-nt", rates]
    return Recomputed(f"{float(change.min()):.2f} to {float(change.max()):.2f}")


def _mean_of_taxonomies(row: dict[str, Any], kind: str) -> float:
    return (row[f"occlusion_{kind}_pct"] + row[f"chaotic_{kind}_pct"]) / 2


def _gap_median() -> Recomputed:
    gaps = [
        _mean_of_taxonomies(row, "textual") / _mean_of_taxonomies(row, "visual")
        for row in published_rows("visual_vs_textual")
    ]
    return Recomputed(f"{median(gaps):.4f}")


def _family_gaps() -> Recomputed:
    rows = {row["model"]: row for row in published_rows("visual_vs_textual")}
    families: dict[str, list[dict[str, Any]]] = {}
    for entry in load_models().values():
        if entry.id in rows:
            families.setdefault(entry.groups.family, []).append(rows[entry.id])
    gaps = {
        family: sum(_mean_of_taxonomies(row, "textual") for row in members)
        / sum(_mean_of_taxonomies(row, "visual") for row in members)
        for family, members in families.items()
    }
    ratio_text = ", ".join(f"{family} {value:.1f}" for family, value in gaps.items())
    return Recomputed(f"{min(gaps.values()):.1f} to {max(gaps.values()):.1f}", ratio_text)


def _figures_by_regime(figure: str, models: Sequence[str]) -> dict[tuple[str, str], dict[str, float]]:
    """Return the printed figure by (model, dataset) and regime."""
    shares: dict[tuple[str, str], dict[str, float]] = {}
    for row in published_rows("behavioral_per_dataset"):
        if row["model"] in models:
            shares.setdefault((row["model"], row["dataset"]), {})[row["regime"]] = row[figure]
    return shares


def _means(cells: dict[tuple[str, str], dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return the equal-weight means over datasets by model and regime."""
    models = dict.fromkeys(model for model, _ in cells)
    model_cells = {model: [cell for (name, _), cell in cells.items() if name == model] for model in models}
    return {model: {r: fmean(cell[r] for cell in parts) for r in PAPER_REGIMES} for model, parts in model_cells.items()}


def _ties() -> Recomputed:
    cells = _figures_by_regime("abs_rec_pct", models_of("main"))
    ties = [" ".join(key) for key, cell in cells.items() if cell["guided"] <= cell["standard"]]
    return Recomputed(f"{len(ties)} ({'; '.join(ties)})")


def _accuracy_kept() -> Recomputed:
    cells = _figures_by_regime("acc_pct", _video_native())
    means = _means(cells)
    counts = [
        sum(abs(row["guided"] - row["standard"]) <= 2 + 1e-9 for row in rows)
        for rows in (means.values(), cells.values())
    ]
    words = f"{counts[0]} of {len(means)} overall, {counts[1]} of {len(cells)} cells"
    return Recomputed(words, agrees=2 * counts[0] > len(means) and 2 * counts[1] > len(cells))


def _reported_above() -> Recomputed:
    return Recomputed(f"{sum(row['pecs'] >= 0.4 for row in published_rows('overall', regime='guided'))}")


def _above_contour() -> Recomputed:
    models = [*models_of("main"), *models_of("replication")]
    acc, abs_rec, false_abs = (
        _means(_figures_by_regime(f"{name}_pct", models)) for name in ("acc", "abs_rec", "false_abs")
    )
    products = {m: acc[m]["guided"] * (abs_rec[m]["guided"] - false_abs[m]["guided"]) / 1e4 for m in models}
    reason = f"gpt-5-high is at {products['gpt-5-high']:.3f} there; its reported PECS is .400"
    return Recomputed(f"{sum(value >= 0.4 for value in products.values())}", reason)


def _json_between() -> Recomputed:
    overall: dict[str, dict[str, float]] = {}
    for row in published_rows("overall"):
        overall.setdefault(row["model"], {})[row["regime"]] = row["pecs"]
    cells = _figures_by_regime("pecs", [*overall])
    counts = [
        sum(row["standard"] < row["json"] < row["guided"] for row in rows)
        for rows in (overall.values(), cells.values())
    ]
    words = f"{counts[0]} of {len(overall)} models overall, {counts[1]} of {len(cells)} cells"
    agrees = 2 * counts[0] > len(overall) and 2 * counts[1] > len(cells)
    return Recomputed(words, "most models overall, but fewer than half of the cells", agrees=agrees)


def _gpt5_chaotic() -> Recomputed:
    rows = published_rows("behavioral_per_dataset", dataset="chaotic", regime="standard")
    rates = [row["abs_rec_pct"] for row in rows if row["model"] in models_of(family="gpt-5")]
    reason = "the original evaluation has 0.0 to 1.3 in the table of visual and textual voids"
    return Recomputed(f"{min(rates):.1f} to {max(rates):.1f}", reason, agrees=max(rates) < 5)


def _same_agreement() -> Recomputed:
    figures = [
        [(row["unanimous_pct"], row["fleiss_kappa"]) for row in rows if row["task"] != "void_abstention"]
        for rows in (published_rows("judge_agreement", dataset=name) for name in ("chaotic", "chaotic_ill_posed"))
    ]
    figure_text = "; ".join(f"{share:g} % and {kappa:.3f}" for share, kappa in figures[0])
    reason = f"both have {figure_text}, though the items, Acc and FalseAbs differ; the epoch is not stated"
    return Recomputed("different" if figures[0] != figures[1] else "equal to three digits", reason)


def _guided_near_zero() -> Recomputed:
    rates = {row["sub_scenario"]: row["guided_abs_rec_pct"] for row in published_rows("occlusion_subscenarios")}
    words = ", ".join(f"{name} {rates[name]:g}" for name in ("slide", "spring", "stack"))
    return Recomputed(words, f"topple has {rates['topple']:g}", agrees=max(rates["spring"], rates["stack"]) < 5)


def _change(table: str, sub_scenario: str, share: str) -> Recomputed:
    (row,) = published_rows(table, sub_scenario=sub_scenario)
    return Recomputed(f"{row[f'guided_{share}_pct'] - row[f'{share}_pct']:.4f}")


def _textual_ratio(sub_scenario: str) -> Recomputed:
    (row,) = published_rows("chaotic_subscenarios", sub_scenario=sub_scenario)
    visual, textual = row["abs_rec_pct"], row["abs_rec_ill_posed_pct"]
    low, high = (textual - 0.05) / (visual + 0.05), (textual + 0.05) / (visual - 0.05)
    (printed_row,) = published_rows("other", id=f"{sub_scenario}-ratio")
    half_unit = 0.05 if "." in printed_row["value"] else 0.5
    agrees = low - half_unit <= float(printed_row["value"]) <= high + half_unit
    return Recomputed(f"{textual / visual:.2f}", f"rounding of the rates allows {low:.1f} to {high:.1f}", agrees=agrees)


def _validated() -> Recomputed:
    validated = ("gemini-2.5-flash", "gemini-2.5-flash-nt", "qwen3-vl-think", "qwen3-vl-instruct")
    sizes = [row["n"] for row in published_rows("confabulation_taxonomy") if row["model"] in validated]
    return Recomputed(f"{sum(sizes)}", " + ".join(map(str, sizes)))


def _es_scores() -> Recomputed:
    positives, missed, labels, n_agreeing = 13, 8, 100, 92
    recall, accuracy = (positives - missed) / positives, 1 - missed / labels
    chance = (positives**2 + (labels - positives) ** 2) / labels**2
    f1, kappa = 2 * recall / (1 + recall), (n_agreeing / labels - chance) / (1 - chance)
    return Recomputed(f"{accuracy:.4f} and {recall:.4f} and {f1:.4f} and {kappa:.4f}")


def _reviewed() -> Recomputed:
    n_kept, corrected, discarded = (text_figure(f"review-{kind}") for kind in ("kept", "corrected", "discarded"))
    return Recomputed(f"{n_kept + corrected + discarded:g}")


def _evaluated() -> Recomputed:
    rows = published_rows("behavioral_per_dataset", model="gpt-5-pro", regime="standard")
    return Recomputed(f"{sum(row['n_pairs'] for row in rows)}")


def _sum(name: str, column: str) -> Recomputed:
    return Recomputed(f"{sum(row[column] for row in published_rows(name)):g}")


def _pairs() -> int:
    return sum(row["n"] for row in published_rows("composition"))


def _calls() -> Recomputed:
    runs = (len(models_of("main")) + len(models_of("replication")) - 1) * 3 + 1  # one model has a single run
    calls = 2 * 3 * runs * _pairs()
    return Recomputed(f"{calls}", agrees=calls > text_figure("vlm-calls"))


CLAIMS: dict[str, Callable[[], Recomputed]] = {
    "best-standard": lambda: _best("standard"),
    "best-guided": lambda: _best("guided"),
    "uplift-video-native-range": lambda: Recomputed(
        f"{_uplifts(_video_native()).min():.4f} to {_uplifts(_video_native()).max():.4f}"
    ),
    "uplift-video-native-median": lambda: Recomputed(f"{_uplifts(_video_native()).median():.4f}"),
    "uplift-main-median": lambda: Recomputed(f"{_uplifts(models_of('main')).median():.4f}"),
    "uplift-main-max": lambda: Recomputed(f"{_uplifts(models_of('main')).max():.4f}"),
    "uplift-gemma": lambda: Recomputed(f"{_uplifts(['gemma-4-e4b']).iloc[0]:.4f}"),
    "uplift-llava": lambda: Recomputed(f"{_uplifts(['llava-next-video-7b']).iloc[0]:.4f}"),
    "frontier-guided": _frontier,
    "naive-gap": _naive_gap,
    "zero-standard": lambda: _zeros("standard"),
    "zero-json": lambda: _zeros("json"),
    "spread-video-native": lambda: _spread(_video_native()),
    "spread-gpt5": lambda: _spread(models_of(family="gpt-5")),
    "gap-chaotic-range": _chaotic_gaps,
    "gap-all-above": _textual_above,
    "think-qwen": _think_qwen,
    "agreement-unanimous": lambda: _range("judge_agreement", "unanimous_pct", 1),
    "agreement-kappa": lambda: _range("judge_agreement", "fleiss_kappa", 3),
    "confab-hp": lambda: _range("confabulation_taxonomy", "hp_pct", 0),
    "confab-ii": lambda: _range("confabulation_taxonomy", "ii_pct", 0),
    "confab-doubt": lambda: _range(
        "confabulation_taxonomy", "doubt_pct", 0, ["gemini-3.1-pro", "gemini-2.5-flash", "qwen3-vl-think"]
    ),
    "judge-accuracy": lambda: _mean("judge_validation", "acc", 100),
    "hidden-vs-observable": lambda: _hidden("abs_rec_pct"),
    "hidden-vs-observable-guided": lambda: _hidden("guided_abs_rec_pct"),
    "flash-thinking": _flash_thinking,
    "human-agreement": lambda: _mean("judge_validation", "human_agree_pct", 1),
    "gap-median": _gap_median,
    "gap-families": _family_gaps,
    "one-tie": _ties,
    "accuracy-kept": _accuracy_kept,
    "nine-reported": _reported_above,
    "nine-contour": _above_contour,
    "json-between": _json_between,
    "gpt5-chaotic": _gpt5_chaotic,
    "same-agreement": _same_agreement,
    "guided-near-zero": _guided_near_zero,
    "uplift-dice-ar": lambda: _change("chaotic_subscenarios", "tumbling_dice", "abs_rec"),
    "uplift-dice-fa": lambda: _change("chaotic_subscenarios", "tumbling_dice", "false_abs"),
    "uplift-seesaw-ar": lambda: _change("chaotic_subscenarios", "seesaw", "abs_rec"),
    "uplift-seesaw-fa": lambda: _change("chaotic_subscenarios", "seesaw", "false_abs"),
    "uplift-pachinko-ar": lambda: _change("chaotic_subscenarios", "pachinko", "abs_rec"),
    "uplift-launch": lambda: _change("occlusion_subscenarios", "launch", "abs_rec"),
    "pachinko-ratio": lambda: _textual_ratio("pachinko"),
    "seesaw-ratio": lambda: _textual_ratio("seesaw"),
    "validated-set": _validated,
    "human-count": lambda: _sum("judge_validation", "human_agree_pct"),
    "es-scores": _es_scores,
    "review-sum": _reviewed,
    "evaluated-pairs": _evaluated,
    "judged-pairs": lambda: Recomputed(f"{_pairs() * 3 * 3}"),
    "calls": _calls,
    **MECHANISM,
}
