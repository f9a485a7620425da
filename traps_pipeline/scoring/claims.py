"""The arithmetic of every statement in `claims.csv`, from the published tables (`audit` compares the results)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import pandas as pd

from traps_pipeline.scoring.analyses import (
    hidden_against_others,
    models_of,
    naive_gap,
    pareto_frontier,
    spread,
    uplift,
    zero_boundary,
)
from traps_pipeline.scoring.published import published, published_cells, published_overall

DOSE_AGAINST_REGIME = (
    "the eight rows of the dose table repeat one alpha 0 cell a target (control 18 on ch and ch_ip, 0 on oc and oc_ip; "
    "void 76, 90, 46, 100); only with another ch target in place of ch to oc_ip would alpha 0 be 11.25 and 66.5"
)


@dataclass(frozen=True)
class Recomputed:
    """A statement as recomputed, in the published wording, and the reason why it may differ."""

    words: str
    reason: str = ""


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
    frontier = pareto_frontier(cells.loc[cells["regime"] == "guided"])
    return Recomputed("; ".join(sorted(frontier["model"])))


def _main_cells(regime: str) -> pd.DataFrame:
    cells = published_cells()
    return cells.loc[cells["model"].isin(models_of("main")) & (cells["regime"] == regime)]


def _naive_gap() -> Recomputed:
    cells = _main_cells("guided")
    return Recomputed(f"{len(naive_gap(cells, 0.03))} of {len(cells)}")


def _zeros(regime: str) -> Recomputed:
    cells = _main_cells(regime)
    at_zero = zero_boundary(cells)
    which = f" ({' '.join(at_zero.iloc[0][['model', 'dataset']])})" if len(at_zero) == 1 else ""
    return Recomputed(f"{len(at_zero)} of {len(cells)}{which}")


def _spread(models: Sequence[str]) -> Recomputed:
    cells = published_cells()
    chosen = cells.loc[cells["model"].isin(models)]
    row = spread(chosen).iloc[0]
    others = [f"{name} {r.q25:.4f}-{r.q75:.4f}" for name, r in _other_spreads(chosen)]
    return Recomputed(
        f"{row['q25']:.4f} to {row['q75']:.4f}",
        f"quartiles over the {int(row['n'])} cells with a spread; other metrics give {', '.join(others)}, and PECS on "
        f"each dataset {', '.join(_dataset_spreads(chosen))}: the published selection of cells is not stated",
    )


def _other_spreads(cells: pd.DataFrame) -> Iterator[tuple[str, pd.Series]]:
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


def _probe_best() -> Recomputed:
    rows = published("probe_transfer").query("model == 'qwen3-vl-8b'")
    best = rows.loc[rows["auroc"].idxmax()]
    return Recomputed(f"{best['auroc']:.3f} ({best['source']} to {best['target']})")


def _probe_shift() -> Recomputed:
    rows = published("probe_transfer").query("model == 'qwen3-vl-8b'")
    means = pd.DataFrame(rows.groupby("transfer_type")[["auroc", "auroc_confabulated"]].mean())
    return Recomputed(f"{(means['auroc'] - means['auroc_confabulated']).max():.4f}")


def _probe_medians() -> Recomputed:
    medians = pd.Series(published("probe_transfer").groupby("model")["auroc_confabulated"].median())
    return Recomputed(f"{medians.min():.4f} to {medians.max():.4f}")


def _steering(side: str) -> Recomputed:
    means = pd.Series(published("steering_dose_qwen").groupby("alpha")[f"{side}_abstention_pct"].mean())
    return Recomputed(f"{means[0]:g} and {means[10]:g}", DOSE_AGAINST_REGIME)


def _steering_families() -> Recomputed:
    rows = published("steering_alpha10_qwen")
    families = pd.Series(rows.groupby(rows["source"].str.removesuffix("_ip"))["control_abstention_pct"].mean())
    return Recomputed(
        f"{families['oc']:g} and {families['ch']:g}",
        "means of the four rows of each family in the alpha 10 table, whose directions are standard; the printed "
        "figures stand in the regime table for guided directions, the paths of which are not published",
    )


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
    "probe-best-qwen": _probe_best,
    "probe-cf-shift": _probe_shift,
    "probe-cf-medians": _probe_medians,
    "steer-control": lambda: _steering("control"),
    "steer-void": lambda: _steering("void"),
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
    "steer-family": _steering_families,
    "flash-thinking": _flash_thinking,
    "human-agreement": lambda: _mean("judge_validation", "human_agree_pct", 1),
}
