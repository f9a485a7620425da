"""The results of the mechanistic stages on the pocket model, over training seeds, as the table that ships with it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from tools.pocket.planted import TRUTHS, planted

from tools.pocket.claims import claimed
from tools.pocket.recipe import SHIPPED
from tools.pocket.seeds import Figure, write_seeds
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES, PROBES, STEERING_SHARES
from traps_pipeline.mechanism.shares import ALL
from traps_pipeline.mechanism.transfer_paths import TRANSFER_TYPES
from traps_pipeline.models.local.checkpoint import as_folder, folder_digest
from traps_pipeline.protocol.datasets import ANSWERABLE, transfer_type
from traps_pipeline.storage.workspace import Workspace

FACTS = "training.json"  # beside the folder of the weights
KINDS = ("void", "shuffled", "random")  # of the first weights; later studies rank directions among nulls instead


FIELDS = tuple(field.name for field in fields(Figure))


def figures_of(workspace: Workspace) -> list[Figure]:
    """Return the figures of a finished workspace. Raises TrapsError when stages are missing, or when the seed of its
    weights is not known."""
    model = looked_into(workspace)
    of = _seed_of(workspace, model)
    probes = workspace.tables.read(PROBES, {"model": model, "prompt": "standard"})
    probes = probes.loc[probes["value"].notna() & (probes["scope"] == "all")]
    figures: list[Figure] = []
    for figure, analysis, flag in (
        ("transfer_best", "transfer", "own_best"),
        ("transfer_chosen", "transfer", "chosen"),
        ("held_out_best", "held_out", "all_sample_best"),
        ("held_out_chosen", "held_out", "chosen"),
        ("answerable_void", "answerable_void", "chosen"),
        ("answerable_control", "answerable_control", "chosen"),
    ):
        rows = probes.loc[(probes["analysis"] == analysis) & probes[flag]]
        if analysis.startswith("answerable"):
            rows = rows.loc[rows["target"] == ANSWERABLE]
        copied = ["source", "target", "layer", "value", "low", "high"]
        figures += [Figure(**of, figure=figure, **row) for row in _records(rows[copied])]
    shuffled = probes.loc[probes["analysis"] == "shuffled"].groupby("source")["value"].mean().reset_index()
    figures += [Figure(**of, figure="shuffled", **row) for row in _records(shuffled)]
    shares = workspace.tables.read(STEERING_SHARES, {})
    over_all = (shares[["path_set", "directions", "regime"]] == ALL).all(axis=1) & (shares["model"] == model)
    shares = shares.rename(columns={"abstention": "value", "n_answers": "answers", "n_scenarios": "scenarios"})
    copied = ["kind", "layer", "alpha", "side", "value", "low", "high", "answers", "scenarios"]
    figures += [Figure(**of, figure="abstention", **row) for row in _records(shares.loc[over_all, copied])]
    for figure, values in (("planted", planted(workspace, model)), ("claim", claimed(workspace))):
        figures += [Figure(**of, figure=figure, kind=name, value=round(v, 6)) for name, v in values.items()]
    return figures


def looked_into(workspace: Workspace) -> str:
    """Return which of the two models a workspace has states of. Raises TrapsError for none or both."""
    models = sorted({*workspace.tables.read_all(HIDDEN_STATES, ["model"])["model"]} & {*SHIPPED})
    if len(models) != 1:
        raise TrapsError(
            f"{workspace.root}: has hidden states of {' and '.join(models) or 'no pocket model'}; run an experiment "
            f"that looks into one of {', '.join(SHIPPED)} in a workspace of its own"
        )
    return models[0]


def _records(rows: Any) -> list[dict[str, Any]]:
    """Return the rows as plain numbers, rounded for the CSV."""
    return json.loads(rows.to_json(orient="records", double_precision=6))


def _seed_of(workspace: Workspace, model: str) -> dict[str, Any]:
    """Return training seed and digest of the weights whose states a workspace has."""
    states = workspace.tables.read_all(HIDDEN_STATES, ["checkpoint", "checkpoint_digest"], model=model)
    checkpoints = sorted(set(zip(states["checkpoint"], states["checkpoint_digest"], strict=True)))
    if len(checkpoints) != 1:
        raise TrapsError(
            f"{workspace.root}: has hidden states of {len(checkpoints)} checkpoints of {model}, but should have one; "
            "run `traps run mechanism` in a workspace of its own for each seed"
        )
    ((name, known),) = checkpoints
    folder = as_folder(name)
    if folder is None or not folder.is_dir() or folder_digest(folder) != known:
        raise TrapsError(
            f"{workspace.root}: was made with a checkpoint {name} ({known[:12]}), but that folder now has other "
            "weights or none; run `traps run mechanism` again with the weights of the seed"
        )
    facts = folder.parent / FACTS
    try:
        origin = json.loads(facts.read_text(encoding="utf-8"))
        return {"seed": int(origin["seed"]), "weights": str(origin["weights"])[:12]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrapsError(
            f"{facts}: does not name the seed of these weights ({error}); `python -m tools.pocket train` writes it"
        ) from error


def write_figures(path: Path, figures: Sequence[Figure]) -> None:
    """Write figures as CSV; they replace those of the same seeds."""
    write_seeds(path, figures, read_figures)


def read_figures(path: Path) -> list[Figure]:
    """Return the figures of a CSV of `write_figures`. Raises TrapsError."""
    integers, numbers = ("seed", "layer", "answers", "scenarios"), ("alpha", "value", "low", "high")
    of: Mapping[str, Callable[[str], Any]] = {**dict.fromkeys(integers, int), **dict.fromkeys(numbers, float)}
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return [
                Figure(**{name: of.get(name, str)(row[name]) for name in FIELDS if row[name]})
                for row in csv.DictReader(stream)
            ]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise TrapsError(
            f"{path}: is not a table of `python -m tools.pocket card --mechanism` ({error}); write it again from the "
            "workspaces"
        ) from error


# --- the model card ---------------------------------------------------------------------------------------------------


def markdown(figures: Sequence[Figure]) -> str:
    """Return the model card's tables: means over training seeds, with the lowest and the highest if there are
    several.
    """
    seeds = sorted({figure.seed for figure in figures})
    parts = [*_planted(figures), *_probes(figures), "", *_steering(figures)]
    return "\n".join([*parts, "", f"Training seeds: {', '.join(map(str, seeds))}."])


def _planted(figures: Sequence[Figure]) -> list[str]:
    """Return what was planted and is found; nothing for weights in which nothing was."""
    lines = ["| planted | expected | found |", "|" + " --- |" * 3]
    for truth in TRUTHS:
        chosen = [figure for figure in figures if (figure.figure, figure.kind) == ("planted", truth.name)]
        if not chosen:
            continue
        value = _over_seeds(chosen, 100, 1) if truth.percent else _over_seeds(chosen)
        lines.append(f"| {truth.label}{', %' * truth.percent} | {truth.wanted} | {value} |")
    return [*lines, ""] if len(lines) > 2 else []


def _probes(figures: Sequence[Figure]) -> list[str]:
    lines = ["| AUROC of probes | best layer | its layers | chosen layer | its layers |", "|" + " --- |" * 5]
    for crossing, label, analysis in (
        *((crossing, crossing, "transfer") for crossing in TRANSFER_TYPES[:3]),
        (TRANSFER_TYPES[0], f"{TRANSFER_TYPES[0]}, fitted without the scored scenario", "held_out"),
    ):
        columns = [label]
        for name in (f"{analysis}_best", f"{analysis}_chosen"):
            chosen = [f for f in figures if f.figure == name and transfer_type(f.source, f.target) == crossing]
            columns += [_over_seeds(chosen), _layers(chosen)]
        lines.append(f"| {' | '.join(columns)} |")
    for name, label in (
        ("shuffled", "label-shuffled, within a dataset, mean over layers"),
        ("answerable_void", "occlusion's probe: void clips, own question against the answerable one"),
        ("answerable_control", "occlusion's probe: void clips with the answerable question against controls"),
    ):
        chosen = [f for f in figures if f.figure == name and (name == "shuffled" or f.source == "occlusion")]
        lines.append(f"| {label} | | | {_over_seeds(chosen)} | {_layers(chosen)} |")
    return lines


def _steering(figures: Sequence[Figure]) -> list[str]:
    shares = [figure for figure in figures if figure.figure == "abstention"]
    alphas = sorted({figure.alpha for figure in shares if figure.alpha is not None})
    heads = ["abstained, %", *(f"α {alpha:g}" for alpha in alphas), "95 % at the last", "answers", "scenarios"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for side in ("void", "control"):
        for kind in KINDS:
            cells = [[f for f in shares if (f.side, f.kind, f.alpha) == (side, kind, alpha)] for alpha in alphas]
            if not cells or not all(cells):
                continue
            top = cells[-1]
            low, high = (pick(getattr(f, end) for f in top) for pick, end in ((min, "low"), (max, "high")))
            columns = [f"{side}s, {kind} directions", *(_over_seeds(cell, 100, 1) for cell in cells)]
            columns += [f"{100 * low:.1f}-{100 * high:.1f}"]
            columns += [_range(f.answers for f in top), _range(f.scenarios for f in top)]
            lines.append(f"| {' | '.join(columns)} |")
    return lines


def _over_seeds(figures: Sequence[Figure], times: float = 1, digits: int = 3) -> str:
    """Return the mean over seeds, with the lowest and the highest if there are several; a seed's value is the mean of
    its figures."""
    by_seed: dict[int, list[float]] = {}
    for figure in figures:
        by_seed.setdefault(figure.seed, []).append(times * figure.value)
    means = [sum(values) / len(values) for values in by_seed.values()]
    if not means:
        return "–"
    mean = f"{sum(means) / len(means):.{digits}f}"
    return mean if len(means) == 1 else f"{mean} ({min(means):.{digits}f}-{max(means):.{digits}f})"


def _layers(figures: Sequence[Figure]) -> str:
    return _range(figure.layer for figure in figures)


def _range(numbers: Any) -> str:
    """Return `4`, or `1-4`; empty where there is none."""
    present = [number for number in numbers if number is not None]
    if not present:
        return ""
    return f"{min(present)}" if min(present) == max(present) else f"{min(present)}-{max(present)}"
