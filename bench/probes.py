"""The probing protocol at the 8B size: 2,808 items x 37 layers x 4,096 columns, synthetic, one layer at a time.

    python bench/probes.py [--layers 37] [--sample 4]

All transfer and all Cf->Cf fits, and all of their evaluations, by the exact solver; then a sample of the same fits by
scikit-learn: on the root of the Gram matrix, at the same precision (newton-cg), and by its default solver. Prints
wall and CPU seconds, peak memory and ratios of CPU time.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from bench.quick import parse
from traps_pipeline.mechanism.probes import Split, auroc, fit_probe, transfer_scores
from traps_pipeline.mechanism.probing import each_layer
from traps_pipeline.mechanism.transfer_paths import TRANSFER_PAIRS
from traps_pipeline.protocol.datasets import DATASETS

PAIRS = {"occlusion": 202, "occlusion_ill_posed": 202, "chaotic": 500, "chaotic_ill_posed": 500}
WIDTH, SHARED = 4096, 400


def layer_states(layer: int) -> dict[str, Split]:
    """Return one layer of all items, float32: what the two sides of a scenario share has a spectrum that falls as 1/k,
    as that of language models does; a weak void direction and noise come on top."""
    rng = np.random.default_rng(layer)

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape, np.float32)

    falling = 1 / np.arange(1, SHARED + 1, dtype=np.float32)
    axes, void = normal(SHARED, WIDTH) * (4 * falling / np.linalg.norm(falling))[:, None], normal(WIDTH)
    splits = {}
    for name, pairs in PAIRS.items():
        scenario, side = np.repeat(np.arange(pairs), 2), np.tile([False, True], pairs)
        shared = normal(pairs, SHARED)[scenario] + np.float32(0.3) * normal(2 * pairs, SHARED)
        states = shared @ axes + np.float32(0.1) * normal(2 * pairs, WIDTH) + np.float32(0.03) * side[:, None] * void
        splits[name] = Split(states, side, scenario)
    return splits


def confabulated(splits: dict[str, Split]) -> dict[str, Split]:
    """Return four in five scenarios of each dataset, as a model that confabulates often has them."""
    return {name: split.rows(split.scenario % 5 != 0) for name, split in splits.items()}


def run_layer(layer: int) -> int:
    """Return all pairs of a layer, all samples and Cf->Cf; returns the number of evaluations."""
    done, splits = 0, layer_states(layer)
    for chosen in (splits, confabulated(splits)):
        for (_, target), scores in transfer_scores(chosen, TRANSFER_PAIRS).items():
            area = float(auroc(chosen[target].void, scores))
            assert 0 <= area <= 1
            done += 1
    return done


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--layers", type=int, default=37)
    parser.add_argument("--sample", type=int, default=4, help="layers whose four fits scikit-learn makes too")
    arguments = parse(parser, layers=1, sample=1)
    began, began_cpu = time.perf_counter(), time.process_time()
    evaluations = sum(each_layer(run_layer, arguments.layers))
    wall, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    fits = 2 * len(DATASETS) * arguments.layers
    print(f"{fits} fits, {evaluations} evaluations, drawing the states included: {wall:.1f} s, {cpu:.1f} CPU s")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GB")
    with threadpool_limits(1):
        _compare(arguments.sample)


def _compare(sample: int) -> None:
    """The same fits by each solver, one BLAS thread each."""
    spent = dict.fromkeys(SOLVERS, 0.0)
    furthest = dict.fromkeys(SOLVERS, 0.0)
    for layer in range(sample):
        for split in layer_states(layer).values():
            exact = fit_probe(split.states, split.void).scores(split.states)
            for name, fit in SOLVERS.items():
                began = time.process_time()
                scores = fit(split)
                spent[name] += time.process_time() - began
                furthest[name] = max(furthest[name], float(np.abs(exact - scores).max()))
    for name in SOLVERS:
        ratio = spent[name] / spent["exact"]
        print(f"{4 * sample} fits, {name}: {spent[name]:.1f} CPU s, {ratio:.1f} times exact; log-odds differ by "
              f"{furthest[name]:.0e} at most")  # fmt: skip


def _sklearn(solver: str, tol: float, split: Split) -> np.ndarray:
    states = StandardScaler().fit_transform(np.asarray(split.states, float))
    fitted = LogisticRegression(solver=solver, tol=tol, max_iter=100_000).fit(states, split.void)
    return fitted.decision_function(states)


def _of_gram(split: Split) -> np.ndarray:
    """The same minimum in as many columns as rows: scikit-learn on the square root of the Gram matrix."""
    states = StandardScaler().fit_transform(np.asarray(split.states, float))
    values, vectors = np.linalg.eigh(states @ states.T)
    rows = vectors * np.sqrt(np.maximum(values, 0))
    return LogisticRegression(solver="newton-cholesky", tol=1e-10).fit(rows, split.void).decision_function(rows)


SOLVERS: dict[str, Callable[[Split], np.ndarray]] = {
    "exact": lambda split: fit_probe(split.states, split.void).scores(split.states),
    "scikit-learn newton-cholesky on the Gram's root": _of_gram,
    "scikit-learn newton-cg, tol 1e-10": partial(_sklearn, "newton-cg", 1e-10),
    "scikit-learn lbfgs, tol 1e-8": partial(_sklearn, "lbfgs", 1e-8),
}


if __name__ == "__main__":
    main()
