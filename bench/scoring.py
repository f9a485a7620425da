"""From votes to the leaderboard at the paper's volume, and its bootstrap against pandas and `scipy.stats.bootstrap`.

16 models, four datasets, three regimes, three runs: about 200,000 pairs and 1.8 million votes of made-up judges. Prints
the seconds of each step and the peak memory (targets: 30 s and 2 GB on 2 cores), then what the same five intervals an
entry take in a straightforward implementation, timed on a few entries of the leaderboard (target: 50 times as long).
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from bench.quick import parse
from traps_pipeline.judging.verdicts import verdicts_of
from traps_pipeline.protocol.datasets import DATASETS, taxonomy_of
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.contrasts import contrasts
from traps_pipeline.scoring.metrics import cell_metrics
from traps_pipeline.scoring.standings import leaderboard

SCENARIOS = {"occlusion": 202, "chaotic": 500}
JUDGES = ("judge-a", "judge-b", "judge-c")
RUNS = (1, 2, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=int, default=16)
    parser.add_argument("--resamples", type=int, default=10_000)
    parser.add_argument("--entries", type=int, default=3, help="entries timed in the straightforward implementation")
    arguments = parse(parser, models=2, resamples=2_000, entries=1)
    items, responses, votes = study(arguments.models)
    print(f"{len(responses) // 2:,} pairs, {len(votes):,} votes")
    began = time.perf_counter()
    verdicts = timed("votes to verdicts", lambda: verdicts_of(items, responses, votes))
    metrics = timed(
        "metrics",
        lambda: pd.concat([cell_metrics(rows) for _, rows in verdicts.groupby("dataset")], ignore_index=True),
    )
    drawn = time.process_time()
    resampled = timed(f"{arguments.resamples:,} resamples", lambda: resample(verdicts, arguments.resamples))
    found = timed("intervals", lambda: intervals(resampled))
    ours = time.process_time() - drawn
    compared = timed("contrasts", lambda: contrasts(resampled, metrics, verdicts))
    board = timed("leaderboard", lambda: leaderboard(metrics, found, compared))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"all: {time.perf_counter() - began:.1f} s (target 30), peak {peak:.2f} GB (target 2), {len(board)} rows")

    theirs = 0.0
    for chosen in ([e for e in resampled.entries if (e[2] == "overall") == whole] for whole in (False, True)):
        picked = chosen[:: max(1, len(chosen) // arguments.entries)][: arguments.entries]
        seconds = float(np.mean([straightforward(verdicts, e, arguments.resamples, found) for e in picked]))
        kind = "overall" if chosen[0][2] == "overall" else "on a dataset"
        print(f"pandas and scipy.stats.bootstrap: CPU {seconds:.2f} s an entry {kind}, of {len(chosen)}")
        theirs += seconds * len(chosen)
    print(f"their CPU {theirs:.0f} s, ours {ours:.1f} s: ratio {theirs / ours:.0f} (target 50)")


def timed(what: str, work: Callable[[], Any]) -> Any:
    began, cpu = time.perf_counter(), time.process_time()
    result = work()
    print(f"{what:<24} {time.perf_counter() - began:6.2f} s, CPU {time.process_time() - cpu:6.2f} s", flush=True)
    return result


def study(models: int) -> tuple[Any, Any, Any]:
    """Return items, responses and votes of a made-up study, with the columns that `verdicts_of` reads."""
    rng = np.random.default_rng(0)
    items = pd.DataFrame(
        [
            (f"{dataset}:s{k}:{side}", f"{taxonomy_of(dataset)}-{k:04d}", f"{dataset}:s{k}", side, dataset)
            for dataset in DATASETS
            for k in range(SCENARIOS[taxonomy_of(dataset)])
            for side in ("control", "void")
        ],
        columns=pd.Index(["item_id", "scenario_id", "pair_id", "side", "dataset"]),
    )
    cells = pd.DataFrame(
        [(f"model-{m:02d}", regime, run) for m in range(models) for regime in REGIMES for run in RUNS],
        columns=pd.Index(["model", "regime", "run"]),
    )
    responses = items.merge(cells, how="cross").assign(
        outcome="answer", is_json=True, epoch="bench", benchmark_version="v"
    )
    tasks = [responses.assign(task="abstention"), responses[responses["side"] == "control"].assign(task="correctness")]
    asked = pd.concat(tasks, ignore_index=True)
    often = ((asked["side"] == "void") | (asked["task"] == "correctness")).to_numpy(bool)
    yes = rng.random(len(asked)) < 0.05 + 0.45 * often
    votes = pd.concat([ballot(asked, judge, yes, rng) for judge in JUDGES], ignore_index=True)
    items = items.assign(category="c", sub_scenario="s", control_answer="yes", benchmark_version="v")
    items = items.drop(columns=["pair_id", "side", "dataset"])
    return items, responses.drop(columns=["scenario_id", "benchmark_version"]), votes


def ballot(asked: pd.DataFrame, judge: str, yes: np.ndarray, rng: np.random.Generator) -> pd.DataFrame:
    """Return one judge's votes: right in 19 of 20, invalid in 1 of 100."""
    said = yes ^ (rng.random(len(asked)) < 0.05)
    on_abstention = (asked["task"] == "abstention").to_numpy(bool)
    abstained, correct = said.astype(object), said.astype(object)
    abstained[~on_abstention], correct[on_abstention] = None, None
    columns = asked.drop(columns=["pair_id", "scenario_id", "outcome"])
    valid = rng.random(len(asked)) > 0.01
    verdict = {"valid": valid, "invalid_reason": None, "abstained": abstained, "correct": correct}
    return columns.assign(judge=judge, panel="three@1", rejects_premise=None, **verdict)


def straightforward(verdicts: Any, entry: tuple[str, str, str], resamples: int, found: Any) -> float:
    """Return CPU seconds for one entry's five percentile intervals, as one would write it; and that ours are hardly
    wider."""
    from scipy.stats import bootstrap

    began = time.process_time()
    model, regime, dataset = entry
    mine = verdicts[(verdicts["model"] == model) & (verdicts["regime"] == regime)]
    parts = {name: decisions(mine[mine["dataset"] == name]) for name in DATASETS if dataset in (name, "overall")}
    samples = sorted({taxonomy_of(name) for name in parts}, reverse=True)  # occlusion, chaotic

    def metric(formula: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
        def statistic(*which: np.ndarray, axis: int) -> np.ndarray:
            means = []
            for name, columns in parts.items():
                drawn = which[samples.index(taxonomy_of(name))].astype(int)
                shares = (np.nanmean(column[drawn], axis=axis - 1) for column in columns)  # the runs come last
                means.append(formula(*shares).mean(axis=-1))
            return np.mean(means, axis=0)

        return statistic

    formulas = {
        "acc": lambda acc, false_abs, abs_rec: acc,
        "false_abs": lambda acc, false_abs, abs_rec: false_abs,
        "abs_rec": lambda acc, false_abs, abs_rec: abs_rec,
        "j": lambda acc, false_abs, abs_rec: abs_rec - false_abs,
        "pecs": lambda acc, false_abs, abs_rec: acc * np.maximum(abs_rec - false_abs, 0),
    }
    scenarios = [np.arange(SCENARIOS[taxonomy]) for taxonomy in samples]
    ends = {}
    for name, formula in formulas.items():
        ends[name] = bootstrap(
            scenarios, metric(formula), vectorized=True, n_resamples=resamples, batch=500, method="percentile",
            rng=np.random.default_rng(1),
        ).confidence_interval  # fmt: skip
    seconds = time.process_time() - began
    ours = found.set_index(["model", "regime", "dataset"]).loc[entry]
    for name, end in ends.items():
        # The unseen scenario of ours makes each end a little wider; percentiles have none.
        wider = end.low - ours[f"{name}_ci_low"], ours[f"{name}_ci_high"] - end.high
        if not -0.005 <= min(wider) <= max(wider) <= 0.02:
            raise SystemExit(f"{entry}: ends of the interval of {name} are wider by {wider[0]:.4f} and {wider[1]:.4f}")
    return seconds


def decisions(rows: Any) -> list[np.ndarray]:
    """correct and abstained on controls, abstained on voids: (scenarios, runs) each."""
    control, void = rows[rows["side"] == "control"], rows[rows["side"] == "void"]
    return [
        frame.pivot(index="scenario_id", columns="run", values=value).astype(float).to_numpy()
        for frame, value in ((control, "correct"), (control, "abstained"), (void, "abstained"))
    ]


if __name__ == "__main__":
    main()
