"""Results with rows of every control inside models, worked out by hand."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import product

import pandas as pd

from traps_pipeline.mechanism.control_rows import (
    GATE,
    INTERACTION,
    ITEM_SCORES,
    LEADS,
    LENS,
    PATCHING,
    PROBE_BASELINES,
    SENTENCES,
    STEERING_NULLS,
)
from traps_pipeline.mechanism.mechanism_rows import COSINES, PROBES, STEERING_EFFECTS
from traps_pipeline.report.result_frames import Results
from traps_pipeline.storage.tables import Table

ABOUT = {"model": "m", "prompt": "standard", "epoch": "e"}


def frame(table: Table, *rows: Mapping[str, object]) -> pd.DataFrame:
    return pd.DataFrame([{**ABOUT, **row} for row in rows]).reindex(columns=pd.Index(table.names))


def probes() -> pd.DataFrame:
    sides = {"n_voids": 16, "n_controls": 16, "layer": 3, "chosen": True, "own_best": True}
    rows = [
        {"analysis": a, "source": s, "target": t, "value": 0.98, "low": 0.79, "high": 1.0} | sides
        for s, t, a in (("chaotic", "chaotic", "held_out"), ("chaotic", "occlusion", "transfer"))
    ]  # fmt: skip
    guided = rows[0] | {"prompt": "guided", "value": 0.96}
    return frame(PROBES, *rows, rows[0] | {"layer": 1, "chosen": False, "value": 0.2}, guided)


def baselines() -> pd.DataFrame:
    rows = []
    for analysis, target in (("held_out", "chaotic"),):
        for features, value in (("time stamps", 1.0), ("output margin", 0.9), ("noise", 0.5)):
            row = {"analysis": analysis, "source": "chaotic", "target": target, "features": features, "value": value}
            rows.append(row | {"spread": 0.1 if features == "noise" else None})
    return frame(PROBE_BASELINES, *rows)


def leads() -> pd.DataFrame:
    """States lead the best rival by .2; the network with random weights has .15 more than its own, a placebo .05."""
    rows = []
    for subject, states, rival in (("model", 0.9, 0.7), ("random_0", 0.65, 0.5), ("length_matched", 0.55, 0.5)):
        at = {"subject": subject, "target": "chaotic", "n_voids": 16, "n_controls": 16, "layer": -1}
        own = {"features": "states", "auroc": states, "low": 0.5, "high": 1.0, "layer": 3, "rival": "question words"}
        own |= {"lead": states - rival, "lead_low": 0.05, "lead_high": 0.3}
        others = {"states, residual": 0.8, "question words": rival, "output margin": rival - 0.1}
        others["first-token logits"] = rival - 0.05
        rows += [at | own, *(at | {"features": name, "auroc": value} for name, value in others.items())]
    return frame(LEADS, *rows)


def interaction() -> pd.DataFrame:
    """States tell .9 within a clip and .8 over clips, those of random weights half; the unchosen layer tells all."""
    rows = []
    for prompt, auroc, within in (("guided", 0.8, 0.9), ("random_0", 0.5, 0.5)):
        at = {"prompt": prompt, "features": "states", "layer": 3, "held_out": "families", "chosen": True}
        at |= {"auroc": auroc, "within": within, "confound": 0.95, "own_effect": 1.0, "other_effect": 0.0}
        others = ({"layer": 4, "chosen": False}, {"held_out": "scenarios"})
        rows += [at, *(at | other | {"auroc": 1.0, "within": 1.0} for other in others)]
        rows.append(at | {"features": "words", "layer": -1, "auroc": 0.5, "within": 0.5, "same": 1.0})
    return frame(INTERACTION, *rows)


def gate() -> pd.DataFrame:
    figures = {"acc": 0.8, "false_abs": 0.1, "abs_rec": 0.9, "pecs": 0.64, "pecs_low": 0.5, "pecs_high": 0.7}
    plain = {"plain_acc": 0.9, "plain_false_abs": 0.0, "plain_abs_rec": 0.5, "plain_pecs": 0.45}
    at = {"regime": "guided", "source": "other datasets", "threshold": "mid", "layer": 3, "expected_false_abs": 0.05}
    row = at | figures | plain | {"n_controls": 64, "n_voids": 64}
    kinds = product(("states", "question words"), ("all", "chaotic"))
    rows = [row | {"features": features, "target": target} for features, target in kinds]
    short = at | {"features": "states", "target": "length_matched", "false_abs": 0.4, "n_controls": 8, "n_voids": 0}
    return frame(GATE, *rows, short)


def patching() -> pd.DataFrame:
    row = {"dataset": "chaotic", "into": "control", "site": "residual", "layer": 0, "group": "stamps"}
    row |= {"low": 0.9, "high": 1.1, "n": 6, "n_left_out": 1, "tokens": 6.0}
    estimated = row | {"source": "pair", "group": "last", "attributed": 0.4, "effect": None}
    own = row | {"source": "pair", "attributed": 0.8, "effect": 0.99}
    return frame(PATCHING, own, estimated, row | {"source": "same side", "effect": 0.01})


def item_scores() -> pd.DataFrame:
    """Two voids, both answered: states rank them above both controls, the output between them."""
    scored = (("void", 2.0, -3.0), ("void", 1.0, -1.0), ("control", -1.0, -2.0), ("control", -4.0, -4.0))
    about = {"dataset": "chaotic", "abstained_standard": False}
    rows = [about | {"item_id": str(n), "side": s, "others": own, "margin": m}
            for n, (s, own, m) in enumerate(scored)]  # fmt: skip
    return frame(ITEM_SCORES, *rows)


def sentences() -> pd.DataFrame:
    """Of the same items, how likely abstentions are: of the first void least, of the second as of the first control."""
    scored = (-3.0, -1.0, -1.0, -2.0)
    rows = [{"item_id": str(n), "abstention": abstention, "own": -0.5} for n, abstention in enumerate(scored)]
    return frame(SENTENCES, *rows)


def lens() -> pd.DataFrame:
    at = {("standard", 1): (-4, -5), ("guided", 1): (-4, -5), ("standard", 2): (-6, -9), ("guided", 2): (1, -8)}
    rows = [
        {"dataset": "chaotic", "prompt": prompt, "layer": layer, "voids": float(voids), "controls": float(controls)}
        for (prompt, layer), (voids, controls) in at.items()
    ]
    rows[2]["auroc"] = 0.9  # under standard, at the output
    return frame(LENS, *rows)


def nulls() -> pd.DataFrame:
    row = {"directions": "guided", "regime": "guided", "target": "chaotic", "layer": 3, "unit": "gap", "dose": 1.0}
    row |= {"side": "control", "null": "isotropic", "effect": 0.8, "null_mean": 0.1, "null_lowest": 0.0}
    return frame(
        STEERING_NULLS,
        row
        | {
            "null_highest": 0.3,
            "draws": 20,
            "n_at_least": 0,
            "p": 1 / 21,
            "n": 5,
            "undecided": 0.2,
            "null_undecided": 0.1,
        },
    )


def effects() -> pd.DataFrame:
    along = {"directions": "standard", "regime": "guided", "source": "chaotic", "target": "chaotic", "layer": 3}
    doses = (("alpha", 0.0, 0.0), ("alpha", 10.0, 10.0), ("gap", 0.0, 0.0), ("gap", 1.0, 200.0))
    kinds = (("void", 0), ("isotropic", 0), ("isotropic", 1))
    rows = [
        along
        | {"kind": kind, "draw": draw, "side": side, "unit": unit, "dose": dose, "alpha": alpha}
        | {"signs": "label", "abstention": dose / 10, "n": 5}
        for (kind, draw), side, (unit, dose, alpha) in product(kinds, ("control", "void"), doses)
    ]
    return frame(STEERING_EFFECTS, *rows)


class Made(Results):
    """Results with rows of every control."""

    source, is_study = "made up", True
    prompted_probes = cached_property(lambda _: probes())
    baselines = cached_property(lambda _: baselines())
    gate = cached_property(lambda _: gate())
    patching = cached_property(lambda _: patching())
    item_scores = cached_property(lambda _: item_scores())
    leads = cached_property(lambda _: leads())
    interaction = cached_property(lambda _: interaction())
    cosines = cached_property(lambda _: frame(COSINES))
    effects = cached_property(lambda _: effects())
    lens = cached_property(lambda _: lens())
    sentences = cached_property(lambda _: sentences())
    nulls = cached_property(lambda _: nulls())
