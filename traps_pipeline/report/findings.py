"""State findings of the leading mechanistic figures, one sentence per model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base.terminal import plain
from traps_pipeline.base.wording import count_noun, in_percent
from traps_pipeline.protocol.datasets import SHORT
from traps_pipeline.protocol.regimes import PROMPTING
from traps_pipeline.report.figures.expression_figures import orders, scored_items
from traps_pipeline.report.result_frames import Results
from traps_pipeline.report.tables.control_reports import beside
from traps_pipeline.report.tables.inside_columns import SHORTCUTS

if TYPE_CHECKING:
    import pandas as pd

ALPHA = 0.05 + 1e-9
_SCORES = {"states": "states", "margin": "first token", "sentences": "whole abstentions"}
_CELL = ("directions", "regime", "target", "layer", "unit", "dose", "side")


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
            f"{', '.join(f'{_SCORES[name]} {mean:.2f}' for name, mean in means.items())}."
        )


@_join_sentences
def lens(results: Results) -> Iterator[str]:
    """Yield how far guided prompting moves each side's margin at the last two layers."""
    for model, group in _models(results.lens):
        means = group.groupby(["prompt", "layer"], observed=True).agg(
            voids=("voids", "mean"), controls=("controls", "mean")
        )
        row_of = {(row["prompt"], row["layer"]): row for row in means.reset_index().to_dict("records")}
        top = max(layer for _, layer in row_of)
        if not all((prompt, layer) in row_of for prompt in PROMPTING for layer in (top, top - 1)):
            continue
        shifts = [
            row_of["guided", layer][side] - row_of["standard", layer][side]
            for layer in (top, top - 1)
            for side in ("voids", "controls")
        ]
        yield (
            f"In {model} the guided prompt moves the log-odds of abstaining by {shifts[0]:+.1f} on voids and "
            f"{shifts[1]:+.1f} on controls at the last layer, and by {shifts[2]:+.1f} and {shifts[3]:+.1f} one layer "
            "before (means over datasets)."
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
    """Yield where directions exceed 19 of 20 draws of every null, by side."""
    rows = results.nulls
    for model, group in _models(rows.loc[rows["target"] != "all"]):
        cells: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
        for row in group.to_dict("records"):
            row_keys = {str(name): value for name, value in row.items()}
            cells.setdefault(tuple(row_keys[name] for name in _CELL), []).append(row_keys)
        ahead = [cell_rows[0] for cell_rows in cells.values() if all(row["p"] <= ALPHA for row in cell_rows)]
        best = max(ahead, key=lambda row: row["effect"], default=None)
        yield (
            f"{model}: void directions do more than 19 of 20 draws of every null in {len(ahead)} of "
            f"{count_noun(len(cells), 'cell')}" + (f", most of all {_cell(best)}." if best else ".")
        )


def _cell(row: dict[str, Any]) -> str:
    change_word = "more" if row["side"] == "control" else "fewer"
    return (
        f"{SHORT[row['target']]} at {row['dose']:g} {row['unit']} along its direction of {row['directions']} states, "
        f"where {in_percent(row['effect'])} {change_word} of {row['n']} {row['side']}s are abstained on"
    )


@_join_sentences
def patching(results: Results) -> Iterator[str]:
    """Return the position group with the largest effect at first and last layer."""
    rows = results.patching
    rows = rows.loc[(rows["source"] == "pair") & (rows["site"] == "residual") & rows["effect"].notna()]
    for model, group in _models(rows.loc[rows["group"] != "all"]):
        means = group.groupby(["layer", "group"], observed=True).agg(effect=("effect", "mean")).reset_index()
        first, last = (
            max(means.loc[means["layer"] == layer].to_dict("records"), key=lambda row: row["effect"])
            for layer in (group["layer"].min(), group["layer"].max())
        )
        prompt = " and ".join(sorted({*group["prompt"]}))
        yield (
            f"In {model}, under {prompt}, the difference of the output is carried by {first['group']} tokens at the "
            f"embeddings ({first['effect']:.2f} of it) and by {last['group']} at the last layer ({last['effect']:.2f})."
        )
