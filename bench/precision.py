"""The width of PECS's interval that a plan promises, beside the width that the leaderboard then has.

The reference models that leave something to chance answer the benchmark's own scenarios in studies of one run (three
regimes, nine runs): all 702 scenarios, the lite set, and the demo's 32. Their answers depend on a call's key alone, so
no clip is rendered. With `--study WORKSPACE` the leaderboard of a finished study is read as well: there each reference
model has one study a regime, and those that leave nothing to chance have a width of 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from bench.quick import parse
from traps_pipeline.base.terminal import text_table
from traps_pipeline.base.yamlfile import read_yaml
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.models.baselines.reference import STRATEGIES
from traps_pipeline.models.registry.entries import get_model
from traps_pipeline.models.request import Request
from traps_pipeline.pipeline.experiment import LITE_FILE, load_experiment
from traps_pipeline.protocol.datasets import DATASETS, SIDES, datasets_of_category
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.scoring.bootstrap import intervals, resample
from traps_pipeline.scoring.power import Shares, precision
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.workspace import Workspace

RUNS, RESAMPLES = range(1, 10), 2000
# What the parameters in the registry make of these: an answer is right on every control.
SHARES = {
    "random-50": Shares(0.5, 0.5, 0.5),
    "confidence-noise": Shares(0.8, 0.2, 0.2),
    "oracle": Shares(1, 1, 0),
    "always-abstain": Shares(0, 1, 1),
    "perfect-answerer": Shares(1, 0, 0),
    "inverse-oracle": Shares(0, 0, 1),
}
BY_CHANCE = ("random-50", "confidence-noise")


def verdicts(model: str, regime: str, run: int, scenarios: Sequence[str]) -> Iterator[dict[str, object]]:
    """Yield what the panel decides of a reference model's answers to all pairs of these scenarios in one study."""
    entry, released = get_model(model), load_released()
    for name in scenarios:
        spec = released[name]
        for dataset in datasets_of_category(spec.category):
            for side in SIDES:
                truth = spec.ground_truth if side == "control" else None
                about = {"item_id": f"{dataset}:{name}:{side}", "model": model, "regime": regime, "run": run}
                secret = {"side": side, "ground_truth": truth, "labels": spec.labels}
                asked = Request(model, entry.endpoint, entry.params, regime, spec.question, about, secret=secret)
                said = STRATEGIES[entry.params["strategy"]](asked)
                yield {
                    "model": model,
                    "regime": f"{regime}-{run}",  # every run is a study of its own
                    "dataset": dataset,
                    "run": 1,
                    "scenario_id": name,
                    "side": side,
                    "abstained": said is None,
                    "correct": said == truth if side == "control" else None,
                }


def observed(model: str, scenarios: Sequence[str]) -> float:
    """Return the mean width of the interval of overall PECS over the studies."""
    rows = [row for regime in REGIMES for run in RUNS for row in verdicts(model, regime, run, scenarios)]
    found = intervals(resample(pd.DataFrame(rows), RESAMPLES)).set_index("dataset").loc["overall"]
    return float((found["pecs_ci_high"] - found["pecs_ci_low"]).mean())


def pairs_of(scenarios: Sequence[str]) -> dict[str, int]:
    """Return the number of pairs of each dataset."""
    categories = [load_released()[name].category for name in scenarios]
    return {d: sum(d in datasets_of_category(category) for category in categories) for d in DATASETS}


def compared(size: str, model: str, pairs: Mapping[str, int], seen: float) -> tuple[str, ...]:
    """Return a row of the table."""
    promised = precision(pairs, SHARES[model]).width
    return size, model, f"{promised:.4f}", f"{seen:.4f}", f"{promised / seen - 1:+.1%}" if seen else "-"


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", type=Path, help="the workspace of a finished study")
    parser.add_argument("--sizes", type=int, default=3, help="so many of the sizes, the smallest first")
    arguments = parse(parser, sizes=1)
    sizes = {
        "demo, 32": [name for name in load_experiment("demo").scenarios or [] if name in load_released()],  # pairs
        "lite, 200": read_yaml(LITE_FILE)["scenarios"],
        "all 702 scenarios": [*load_released()],
    }
    rows = [
        compared(size, model, pairs_of(names), observed(model, names))
        for size, names in [*sizes.items()][: arguments.sizes]
        for model in BY_CHANCE
    ]
    if arguments.study:
        rows += of_study(Workspace.open(arguments.study))
    print(text_table(("study", "model", "promised", "observed", "off by"), rows))


def of_study(workspace: Workspace) -> list[tuple[str, ...]]:
    """Return rows of the reference models of a study, each with the mean over its regimes."""
    board = workspace.tables.read(LEADERBOARD, {})
    counts = board.loc[board["dataset"] != "overall"].groupby("dataset")["n_pairs"].max()
    overall = board.loc[board["dataset"] == "overall"].set_index("model")
    widths = (overall["pecs_ci_high"] - overall["pecs_ci_low"]).groupby("model").mean()
    return [
        compared(workspace.study.name, model, {str(d): int(n) for d, n in counts.items()}, float(widths[model]))
        for model in SHARES
        if model in widths.index
    ]


if __name__ == "__main__":
    main()
