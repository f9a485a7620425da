"""The lite set: which 200 scenarios it has, and how faithfully 100 + 100 scenarios in one run stand for all of them.

The set is chosen by design alone: of each family its share of 100 (largest remainders), answers in turn, by digest. The
fidelity is simulated from the paper's published shares: answers are drawn independently at each model's rates, for all
scenarios in three runs, for 100 + 100 and for 50 + 50 in one run. Printed are Kendall's tau of the overall PECS with
that of the full study, the share of the full study's separations (differences beyond 1.96 standard errors) that the
small one finds as well, the mean error of PECS against the published rates, and the share of the calls. Half of the
models are printed apart, so that what one half says can be checked on the other. `--write` writes assets/lite.yaml.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
from scipy.stats import kendalltau

from bench.quick import parse
from traps_pipeline.base.digests import digest
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.protocol.datasets import DATASETS, datasets_of_category, taxonomy_of
from traps_pipeline.scoring.published import published_cells

FULL, RUNS = {"occlusion": 202, "chaotic": 500}, 3
STUDIES = {"50 + 50, one run": 50, "100 + 100, one run": 100}
DRAWS = 400


def chosen(most: int = 100) -> list[str]:
    """Return the scenarios of the lite set, `most` of each taxonomy."""
    by_family: dict[tuple[str, str], list[tuple[str, str]]] = defaultdict(list)
    for name, spec in load_released().items():
        by_family[datasets_of_category(spec.category)[0], spec.family].append((spec.ground_truth, name))
    names = list[str]()
    for taxonomy in FULL:
        families = {family: rows for (of, family), rows in by_family.items() if of == taxonomy}
        exact = {family: most * len(rows) / sum(map(len, families.values())) for family, rows in families.items()}
        counts = {family: int(share) for family, share in exact.items()}
        for family in sorted(exact, key=lambda family: counts[family] - exact[family])[: most - sum(counts.values())]:
            counts[family] += 1
        for family, rows in families.items():
            names += _in_turn(rows)[: counts[family]]
    return sorted(names)


def _in_turn(rows: list[tuple[str, str]]) -> list[str]:
    """Return the names with their answers in turn, those of an answer by digest."""
    by_answer: dict[str, list[str]] = defaultdict(list)
    for answer, name in sorted(rows, key=lambda row: digest(row[1])):
        by_answer[answer].append(name)
    queues, names = [by_answer[answer] for answer in sorted(by_answer)], list[str]()
    while any(queues):
        names += [queue.pop(0) for queue in queues if queue]
    return names


def simulated(shares: np.ndarray, pairs: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return overall PECS and its standard error by the delta method, (models,) each, of answers drawn at these rates.
    shares: (models, datasets, 3) of Acc, AbsRec, FalseAbs; pairs: (datasets,)."""
    acc, rec, false = (rng.binomial(pairs, shares[..., k]) / pairs for k in range(3))
    j = np.maximum(rec - false, 0)
    variance = j**2 * acc * (1 - acc) + acc**2 * (rec * (1 - rec) + false * (1 - false)) + 2 * j * acc**2 * false
    return (acc * j).mean(axis=1), np.sqrt((variance / pairs).sum(axis=1)) / len(pairs)


def separated(pecs: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the sign of each pair's difference where it lies beyond 1.96 standard errors, else 0: (models, models)."""
    difference = pecs[:, None] - pecs[None, :]
    beyond = np.abs(difference) > 1.96 * np.hypot(error[:, None], error[None, :])
    return np.sign(difference) * beyond


def fidelity(shares: np.ndarray, most: int, rng: np.random.Generator, draws: int) -> tuple[float, float, float]:
    """Return tau, share of separations kept, mean error of PECS, means over `draws`."""
    full = np.array([FULL[taxonomy_of(dataset)] * RUNS for dataset in DATASETS])
    small = np.full(len(DATASETS), most)
    truth = (shares[..., 0] * np.maximum(shares[..., 1] - shares[..., 2], 0)).mean(axis=1)
    found = []
    for _ in range(draws):
        (whole, whole_error), (part, part_error) = (simulated(shares, pairs, rng) for pairs in (full, small))
        apart, kept = separated(whole, whole_error), separated(part, part_error)
        share = (apart == kept)[apart != 0].mean()
        found.append((kendalltau(whole, part)[0], share, np.abs(part - truth).mean()))
    tau, share, error = np.mean(found, axis=0)
    return float(tau), float(share), float(error)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write assets/lite.yaml")
    parser.add_argument("--draws", type=int, default=DRAWS, help="simulated evaluations of each kind")
    arguments = parse(parser, draws=20)
    if arguments.write:
        head = "# 100 scenarios of each taxonomy, balanced over families and answers (bench/lite.py --write).\n"
        (ASSETS / "lite.yaml").write_text(head + "scenarios:\n" + "".join(f"  - {name}\n" for name in chosen()))
    cells = published_cells()
    for regime in ("standard", "guided"):
        table = cells.loc[cells["regime"] == regime].set_index(["model", "dataset"])
        models = [
            m for m in dict.fromkeys(table.index.get_level_values(0)) if all((m, d) in table.index for d in DATASETS)
        ]
        rates = np.array(
            [[table.loc[(m, d), ["acc", "abs_rec", "false_abs"]] for d in DATASETS] for m in models], float
        )
        for what, half in (("all", slice(None)), ("one half", slice(0, None, 2)), ("the other", slice(1, None, 2))):
            for name, most in STUDIES.items():
                tau, share, error = fidelity(rates[half], most, np.random.default_rng(1), arguments.draws)
                cost = 2 * most / (sum(FULL.values()) * RUNS)
                print(
                    f"{regime}, {what} ({len(rates[half])} models), {name}: tau {tau:.2f}, {share:.0%} of separations, "
                    f"PECS off by {error:.3f}, {cost:.1%} of the calls"
                )


if __name__ == "__main__":
    main()
