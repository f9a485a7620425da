"""How often the intervals of docs/scoring.md hold the truth, by size, strength and dependence, and how wide they are.

Studies are drawn with known shares: every scenario has a family (a shift of its difficulty), an effect that all its
items share, an effect of each item that its runs share, and noise. Each study is resampled by the code that the
leaderboard and two events use (`scoring.bootstrap`), and by the percentile bootstrap that it replaced ("before").
`--quick` takes half a minute of CPU; the full run thirteen. `--csv FILE` keeps every setting; the printed tables have
the lowest coverage and the mean width over the strengths and kinds of dependence of a size, and PECS by strength.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import norm

from bench.quick import parse
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.scoring.bootstrap import (
    RESAMPLED_METRICS,
    TAXONOMIES,
    Resampling,
    difference,
    draw_scenarios,
    interval,
    limits_of,
    metrics_of,
    quantile,
    resampled_sums,
    scenario_weights,
    with_unseen,
)
from traps_pipeline.scoring.metrics import pecs_of

SIZES = {
    "1": (1, 0),
    "2": (1, 1),
    "4": (2, 2),
    "8": (4, 4),
    "16": (8, 8),
    "36 (32 + 4)": (32, 4),
    "100": (50, 50),
    "200 (lite)": (100, 100),
    "702 (all)": (351, 351),
}
STRENGTHS = {  # Acc, AbsRec, FalseAbs
    "weak": (0.35, 0.3, 0.2),
    "middle": (0.6, 0.5, 0.1),
    "strong": (0.95, 0.97, 0.02),
    "nearly perfect": (0.995, 0.995, 0.005),
    "perfect": (1.0, 1.0, 0.0),
    "J = 0": (0.5, 0.4, 0.4),
    "always abstains": (0.0, 1.0, 1.0),
    "never abstains": (0.6, 0.0, 0.0),
}
DEPENDENCE = {  # shares of the variance that a scenario's items and an item's runs have in common; spread of families
    "independent, 1 run": (0.0, 0.0, 0.0, 1),
    "clustered, 1 run": (0.5, 0.3, 0.6, 1),
    "clustered, 3 runs": (0.5, 0.3, 0.6, 3),
}
LANES = ("other event seen", "other event hidden")  # two events: controls have the asked event seen, voids hidden
STUDIES, RESAMPLES, PARTS = 25, 1000, 12
N_FAMILIES = 8
METRICS = (
    *(f"{name}, one dataset" for name in RESAMPLED_METRICS),
    *RESAMPLED_METRICS,
    "specificity",
    "difference of j",
    "difference of pecs",
)
LIMITS = {"specificity": (-1.0, 1.0), "difference of j": (-2.0, 2.0), "difference of pecs": (-1.0, 1.0)}


@dataclass(frozen=True)
class Setting:
    """A size, a strength and a kind of dependence."""

    size: str
    strength: str
    dependence: str

    @property
    def families(self) -> np.ndarray:
        """The shift of each family: (N_FAMILIES,)."""
        return np.linspace(-1, 1, N_FAMILIES) * DEPENDENCE[self.dependence][2]

    def truth(self) -> dict[str, float]:
        """Return the metrics that these studies estimate."""
        acc, abs_rec, false_abs = (
            self._share(share, way) for share, way in zip(STRENGTHS[self.strength], (1, 1, -1), strict=True)
        )
        pecs = float(pecs_of(np.asarray(acc), np.asarray(abs_rec - false_abs)))
        known = {"acc": acc, "abs_rec": abs_rec, "false_abs": false_abs, "j": abs_rec - false_abs, "pecs": pecs}
        of_one = {f"{name}, one dataset": value for name, value in known.items()}
        return {**of_one, **known, "specificity": known["j"], "difference of j": 0.0, "difference of pecs": 0.0}

    def _share(self, share: float, way: int) -> float:
        return float(norm.cdf(norm.ppf(share) + way * self.families).mean())

    def counts(self, rng: np.random.Generator, studies: int, scenarios: int, cells: int) -> np.ndarray:
        """Draw COUNTS of one taxonomy: (scenarios, studies, cells, runs, 6). A scenario that is easy is answered
        rightly, and its void is abstained on."""
        common, of_item, spread, runs = DEPENDENCE[self.dependence]
        families = rng.permuted(np.tile(np.arange(N_FAMILIES), (studies, 1)), axis=1)
        shift = self.families[families[:, np.arange(scenarios) % N_FAMILIES].T] if spread else np.zeros((1, 1))
        parts = [
            np.sqrt(share) * rng.standard_normal((scenarios, studies, *shape))
            for share, shape in (
                (common, (1, 1, 1)),
                (of_item, (cells, 1, 2)),
                (1 - common - of_item, (cells, runs, 2)),
            )
        ]
        control, void = np.moveaxis(sum(parts) + shift[..., None, None, None], -1, 0)
        acc, abs_rec, false_abs = (norm.ppf(share) for share in STRENGTHS[self.strength])
        one = np.ones(control.shape)
        return np.stack([control > -acc, one, control < false_abs, one, void > -abs_rec, one], axis=-1).astype(float)


def cell_metrics(counts: np.ndarray, drawn: Resampling, taxonomy: str, named: str, in_mean: bool) -> np.ndarray:
    """Return ends of metrics of a dataset or arm, mean over runs: (studies, 2, metrics, 1 + resamples)."""
    scenarios, studies, runs, kinds = counts.shape
    sums = resampled_sums(drawn.scenarios[taxonomy][1], counts.reshape(scenarios, studies * runs, kinds))
    having = (counts[..., 1::2] > 0).sum(axis=0)
    whole = with_unseen(sums.reshape(studies, runs, kinds, -1), having, drawn.unseen(named, kinds // 2))
    return np.moveaxis(metrics_of(whole, in_mean).mean(axis=2), 0, 1)


def ends_now(counts: Mapping[str, np.ndarray], drawn: Resampling, model: str) -> dict[str, np.ndarray]:
    """Return the ends of every metric, (studies, 2, 1 + resamples), from counts by dataset and arm."""

    def ends_of(name: str, in_mean: bool) -> np.ndarray:
        return cell_metrics(counts[name], drawn, _taxonomy(name), f"{model}|{name}", in_mean)

    of_one = ends_of(next(iter(counts)), in_mean=False)
    ends = {f"{name}, one dataset": of_one[:, :, k] for k, name in enumerate(RESAMPLED_METRICS)}
    if all(name in counts for name in LANES):
        seen, hidden = (ends_of(name, in_mean=False) for name in LANES)
        asked, other = (
            own[:, :, RESAMPLED_METRICS.index(metric)] for own, metric in ((seen, "abs_rec"), (hidden, "false_abs"))
        )
        ends["specificity"] = difference(asked, other)
    if not all(name in counts for name in DATASETS):
        return ends
    overall = np.mean([ends_of(name, in_mean=True) for name in DATASETS], axis=0)
    return ends | {name: overall[:, :, k] for k, name in enumerate(RESAMPLED_METRICS)}


def draws_before(counts: Mapping[str, np.ndarray], weights: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the resamples of every metric by the percentile bootstrap, (studies, resamples)."""
    metrics = {}
    for name, own in counts.items():
        scenarios, studies, runs, kinds = own.shape
        sums = resampled_sums(weights[_taxonomy(name)], own.reshape(scenarios, studies * runs, kinds))
        with np.errstate(invalid="ignore"):
            acc, false_abs, abs_rec = np.moveaxis(sums[:, 0::2] / sums[:, 1::2], 1, 0)
        stacked = np.stack([metric.formula(acc, false_abs, abs_rec) for metric in METRIC_WORDS.values()])
        metrics[name] = stacked.reshape(len(RESAMPLED_METRICS), studies, runs, -1).mean(axis=2)
    first = next(iter(metrics.values()))
    draws = {f"{name}, one dataset": first[k] for k, name in enumerate(RESAMPLED_METRICS)}
    if all(name in metrics for name in LANES):
        asked, other = (
            metrics[name][RESAMPLED_METRICS.index(metric)]
            for name, metric in zip(LANES, ("abs_rec", "false_abs"), strict=True)
        )
        draws["specificity"] = asked - other
    if not all(name in metrics for name in DATASETS):
        return draws
    overall = np.mean([metrics[name] for name in DATASETS], axis=0)
    return draws | {name: overall[k] for k, name in enumerate(RESAMPLED_METRICS)}


def _taxonomy(name: str) -> str:
    return taxonomy_of(name) if name in DATASETS else TAXONOMIES[0]


def drawn_counts(setting: Setting, rng: np.random.Generator, studies: int) -> dict[str, np.ndarray]:
    """Draw COUNTS of every dataset and of two events, (scenarios, studies, runs, 6) each."""
    counts = {}
    for taxonomy, scenarios in zip(TAXONOMIES, SIZES[setting.size], strict=True):
        if scenarios:
            names = [name for name in (*DATASETS, *LANES) if _taxonomy(name) == taxonomy]
            drawn = setting.counts(rng, studies, scenarios, len(names))
            counts |= {name: drawn[:, :, k] for k, name in enumerate(names)}
    return counts


def measure(setting: Setting, studies: int, resamples: int, seed: int) -> Iterator[dict[str, object]]:
    """Measure coverage and mean width of every metric of one setting, before and now."""
    rng = np.random.default_rng([seed, *setting.size.encode(), *setting.strength.encode()])
    names = [
        (f"{taxonomy}-{k}", taxonomy)
        for taxonomy, n in zip(TAXONOMIES, SIZES[setting.size], strict=True)
        for k in range(n)
    ]
    drawn = draw_scenarios(pd.DataFrame(names, columns=["scenario_id", "taxonomy"]), resamples, seed)
    weights = {
        t: scenario_weights(n, resamples, [seed, n]) for t, n in zip(TAXONOMIES, SIZES[setting.size], strict=True)
    }
    weights = {t: np.concatenate([np.ones((1, own.shape[1]), np.float32), own]) for t, own in weights.items()}
    both = [drawn_counts(setting, rng, studies) for _ in range(2)]
    ends = [ends_now(counts, drawn, model) for counts, model in zip(both, "ab", strict=True)]
    draws = [draws_before(counts, weights) for counts in both]
    truth = setting.truth()
    for metric in METRICS:
        name = metric.removeprefix("difference of ")
        if name not in ends[0]:
            continue
        if name != metric:
            now, before = difference(ends[0][name], ends[1][name]), draws[0][name] - draws[1][name]
            observed = ends[0][name][:, 1, 0] - ends[1][name][:, 1, 0]
        else:
            now, before, observed = ends[0][name], draws[0][name], ends[0][name][:, 1, 0]
        limits = LIMITS.get(metric, limits_of(metric.partition(",")[0]))
        percentiles = np.stack([quantile(before[:, 1:], q) for q in (0.025, 0.975)], axis=-1)
        intervals = {"before": percentiles, "now": interval(now[..., 1:], observed, limits)}
        row = {**vars(setting), "metric": metric, "truth": truth[metric], "studies": studies}
        for which, own in intervals.items():
            holds = (own[:, 0] <= truth[metric] + 1e-9) & (truth[metric] - 1e-9 <= own[:, 1])
            row |= {f"coverage_{which}": holds.mean(), f"width_{which}": (own[:, 1] - own[:, 0]).mean()}
        yield row


def mean_of_parts(setting: Setting, parts: int, seed: int) -> pd.DataFrame:
    """Measure a setting in parts of STUDIES studies, since those of one part share the weights of scenarios, and return
    a row a metric."""
    rows = [row for part in range(parts) for row in measure(setting, STUDIES, RESAMPLES, seed + part)]
    by_metric = pd.DataFrame(rows).groupby(["size", "strength", "dependence", "metric"], sort=False, as_index=False)
    return pd.DataFrame(by_metric.mean(numeric_only=True))


def summary(rows: pd.DataFrame) -> str:
    """Return the Markdown table of lowest coverage and mean width by size and metric, before and now."""
    shown = ("j, one dataset", "acc", "j", "pecs", "specificity", "difference of pecs")
    lines = ["| scenarios | " + " | ".join(shown) + " |", "| --- " * (len(shown) + 1) + "|"]
    for size in SIZES:
        cells = []
        for metric in shown:
            own = rows.loc[(rows["size"] == size) & (rows["metric"] == metric)]
            if own.empty:
                cells.append("")
                continue
            ends = [(own[f"coverage_{which}"].min(), own[f"width_{which}"].mean()) for which in ("before", "now")]
            cells.append(", ".join(f"{coverage:.0%} ({width:.2f})" for coverage, width in ends))
        if any(cells):
            lines.append(f"| {size} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def by_strength(rows: pd.DataFrame, metric: str = "pecs") -> str:
    """Return the Markdown table of a metric's lowest coverage now, by size and strength."""
    lines = [f"| {metric}, scenarios | " + " | ".join(STRENGTHS) + " |", "| --- " * (len(STRENGTHS) + 1) + "|"]
    lowest = rows.loc[rows["metric"] == metric].groupby(["size", "strength"])["coverage_now"].min()
    for size in dict.fromkeys(rows["size"]):
        cells = (f"{lowest[size, name]:.0%}" if (size, name) in lowest.index else "" for name in STRENGTHS)
        lines.append(f"| {size} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, default=len(SIZES), help="how many sizes, the smallest first")
    parser.add_argument("--parts", type=int, default=PARTS, help=f"studies of each setting, in parts of {STUDIES}")
    parser.add_argument("--csv", type=Path, help="write every setting to this file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    arguments = parse(parser, sizes=4, parts=1)
    settings = [Setting(*one) for one in product([*SIZES][: arguments.sizes], STRENGTHS, DEPENDENCE)]
    run = partial(mean_of_parts, parts=arguments.parts, seed=arguments.seed)
    tables = list[pd.DataFrame]()
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        for setting, rows in zip(settings, pool.map(run, settings), strict=True):
            tables.append(rows)
            print(f"{len(tables)} of {len(settings)}: {', '.join(vars(setting).values())}", file=sys.stderr)
    table = pd.concat(tables, ignore_index=True)
    if arguments.csv:
        table.to_csv(arguments.csv, index=False)
    print(summary(table), by_strength(table), sep="\n\n")
    worst = table.sort_values("coverage_now").head(8)
    print(
        worst[["size", "strength", "dependence", "metric", "coverage_before", "coverage_now", "width_now"]].to_string()
    )


if __name__ == "__main__":
    main()
