"""State findings of the leading mechanistic figures, one sentence per model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun, in_percent
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.figures.expression_figures import SCORES, orders, scored_items
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.control_reports import beside
from traps_pipeline.report.tables.inside_columns import SHORTCUTS

if TYPE_CHECKING:
    import pandas as pd

ALPHA = 0.05 + 1e-9
_CELL = ["regime", "target", "layer", "unit", "dose", "side"]
_POSITIONS = {"changed": "changed visual tokens", "unchanged": "unchanged visual tokens", "last": "the last token"}


def _join_sentences(sentences: Callable[[Results], Iterator[str]]) -> Callable[[Results], str]:
    return lambda results: " ".join(sentences(results))


def _models(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    for model, group in rows.groupby("model", sort=False, observed=True):
        yield plain(str(model)), group


@_join_sentences
def states_and_output(results: Results) -> Iterator[str]:
    """Yield how many answered voids states and output detect, and their AUROC."""
    for model, group in _models(scored_items(results)):
        voids = group.loc[(group["side"] == "void") & group["abstained_standard"].eq(False)]
        controls = group.loc[group["side"] == "control"]
        if not len(voids):
            yield f"{model} answered no void under standard: nothing is encoded and not expressed."
            continue
        encoded, expressed = (int((voids[name] > 0).sum()) for name in ("own", "margin"))
        n_wrong = int((controls["own"] > 0).sum())
        areas = [orders(part) for _, part in group.groupby("dataset", sort=False, observed=True)]
        means = {
            name: sum(area[name] for area in areas) / len(areas) for name in areas[0] if all(name in a for a in areas)
        }
        yield (
            f"{model} answered {count_noun(len(voids), 'void')} under standard: its states put {encoded} of them among "
            f"voids (and {n_wrong} of {count_noun(len(controls), 'control')}), its output {expressed}; as orders of "
            f"sides (AUROC, mean of datasets): "
            f"{', '.join(f'{SCORES[name]} {mean:.2f}' for name, mean in means.items())}."
        )


@_join_sentences
def lens(results: Results) -> Iterator[str]:
    """Yield how far voids lie above controls, by prompt, at the last two layers."""
    for model, group in _models(results.lens):
        means = group.groupby(["prompt", "layer"], observed=True).agg(
            voids=("voids", "mean"), controls=("controls", "mean")
        )
        row_of = {(row["prompt"], row["layer"]): row for row in means.reset_index().to_dict("records")}
        top = max(layer for _, layer in row_of)
        if not all((prompt, layer) in row_of for prompt in PROMPTING for layer in (top, top - 1)):
            continue
        above = [
            row_of[prompt, layer]["voids"] - row_of[prompt, layer]["controls"]
            for layer in (top, top - 1)
            for prompt in PROMPTING
        ]
        yield (
            f"In {model}, voids lie {above[0]:+.1f} above controls in log-odds of abstaining under {PROMPTING[0]} and "
            f"{above[1]:+.1f} under {PROMPTING[1]} at the last layer; one layer before, {above[2]:+.1f} and "
            f"{above[3]:+.1f} (means over datasets)."
        )


@_join_sentences
def probe_baselines(results: Results) -> Iterator[str]:
    """Yield on how many pairs, within and across datasets, states beat all baselines."""
    for model, group in _models(beside(results)):
        states, noise, spread = (group[name].to_numpy(float) for name in ("value", "noise", "noise_spread"))
        baseline_scores = np.column_stack([group[[*SHORTCUTS, "output margin"]].to_numpy(float), noise + 2 * spread])
        is_above, across = (
            states > np.fmax.reduce(baseline_scores, axis=1),
            (group["source"] != group["target"]).to_numpy(bool),
        )
        counts = [
            f"{np.count_nonzero(is_above & kind)} of {count_noun(int(np.count_nonzero(kind)), noun)}"
            for kind, noun in ((across, "pair"), (~across, "dataset"))
        ]
        yield (
            f"{model}: states are above every raw input, the output margin and noise on {counts[0]} of datasets, "
            f"and within {counts[1]}."
        )


@_join_sentences
def gate_arrows(results: Results) -> Iterator[str]:
    """Yield the default gate's effect on PECS, and the best gate on other features."""
    rows = results.gate
    rows = rows.loc[(rows["source"] == "other datasets") & (rows["threshold"] == "mid") & (rows["target"] == "all")]
    for model, group in _models(rows.loc[rows["pecs"].notna()]):
        for regime, part in group.groupby("regime", sort=False, observed=True):
            gates = {row["features"]: row for row in part.to_dict("records")}
            states_gates = gates.pop("states", None)
            if states_gates is None or not gates:
                continue
            best = max(gates.values(), key=lambda row: row["pecs"])
            yield (
                f"{model} under {regime}: a gate on states takes PECS from {states_gates['plain_pecs']:.2f} to "
                f"{states_gates['pecs']:.2f}, the best other gate ({best['features']}) to {best['pecs']:.2f}."
            )


@_join_sentences
def doses_among_nulls(results: Results) -> Iterator[str]:
    """Yield where directions of each prompt's states exceed 19 of 20 draws of all nulls."""
    rows = results.nulls
    for model, of_model in _models(rows.loc[rows["target"] != "all"]):
        for directions, group in of_model.groupby("directions", sort=False, observed=True):
            cells = [of_cell for _, of_cell in group.groupby(_CELL, sort=False, observed=True)]
            ahead = [
                of_cell.to_dict("records")[0] for of_cell in cells if (of_cell["p"].to_numpy(float) <= ALPHA).all()
            ]
            best = max(ahead, key=lambda row: row["effect"], default=None)
            yield (
                f"{model}: void directions of {directions} states do more than 19 of 20 draws of every null in "
                f"{len(ahead)} of {count_noun(len(cells), 'cell')}" + (f", most of all {_cell(best)}." if best else ".")
            )


def _cell(row: Mapping[Any, Any]) -> str:
    moved = "more" if row["side"] == "control" else "fewer"
    dose = f"{row['dose']:g} × the class gap" if row["unit"] == "gap" else f"α {row['dose']:g}"
    return (
        f"{SHORT[row['target']]} at {dose}, where {in_percent(row['effect'])} {moved} of {row['n']} {row['side']}s are "
        "abstained on"
    )


@_join_sentences
def patching(results: Results) -> Iterator[str]:
    """Yield the positions with the largest effect at first and last layer."""
    rows = results.patching
    rows = rows.loc[(rows["source"] == "pair") & (rows["site"] == "residual") & rows["effect"].notna()]
    for model, group in _models(rows.loc[rows["group"] != "all"]):
        cells = group.groupby(["layer", "group"], observed=True)
        means = cells.agg(effect=("effect", "mean"), panels=("effect", "size")).reset_index()
        panels = len(group[["dataset", "into"]].drop_duplicates())
        best = (
            max(means.loc[means["layer"] == layer].to_dict("records"), key=lambda row: row["effect"])
            for layer in (group["layer"].min(), group["layer"].max())
        )
        shares = (
            f"{row['effect']:.2f} by {_POSITIONS.get(row['group'], row['group'])} at layer {row['layer']} (mean of the "
            f"{row['panels']} of {panels} panels patched there)"
            for row in best
        )
        prompt = " and ".join(sorted({*group["prompt"]}))
        yield f"In {model} under {prompt}, of the output’s difference a patch gives {' and '.join(shares)}."
