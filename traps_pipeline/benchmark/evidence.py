"""The certificates that a record carries, held against their thresholds: what the scene_specs stage checks each time.

The evidence was computed when the scenario was resolved; `scenes.certify` derives it anew from the trajectories.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from traps_pipeline.scenes import ensemble
from traps_pipeline.scenes.kit import Physics
from traps_pipeline.scenes.outcome import COMMITTED_BEFORE_END_S
from traps_pipeline.scenes.registry import get_family
from traps_pipeline.scenes.spec import SceneSpec
from traps_pipeline.scenes.wording import refutation

Evidence = Mapping[str, Any]


def unanswerable_controls(specs: Iterable[SceneSpec]) -> list[str]:
    """Records whose evidence does not certify the control; one sentence each."""
    found = []
    for spec in specs:
        last = (Physics(**spec.physics).n_frames - 1) / spec.physics["fps"]
        rules: dict[str, Callable[[Evidence], bool]] = {
            "settled 0.6 s before the end": lambda e, end=last: e["commit_s"] <= end - COMMITTED_BEFORE_END_S + 1e-6,
            "margin": lambda e, family=spec.family: e["margin_m"] >= get_family(family).min_margin_m - 1e-5,
            "legible": lambda e: e["least_visible_px"] > 0,
        }
        found += _broken(spec, rules)
    return found


def answerable_voids(specs: Iterable[SceneSpec]) -> list[str]:
    """Records whose evidence does not certify the void; one sentence each."""
    found = []
    for spec in specs:
        if spec.void_kind == "occluder":
            rules: dict[str, Callable[[Evidence], bool]] = {
                "hidden before it is settled": lambda e: e["hidden_from_s"] < e["commit_s"],
                "nothing leaks": lambda e: e["ablation_px"] == 0,
                "twin": lambda e: e["twin_px"] == 0,
            }
        else:
            cut_s = spec.void["cut_frame"] / spec.physics["fps"]
            bound = ensemble.MIN_ENTROPY_THREE_LABELS_BITS if len(spec.labels) == 3 else ensemble.MIN_ENTROPY_BITS
            rules = {
                "cut at 1.0 s or later": lambda e, cut=cut_s: ensemble.EARLIEST_CUT_S <= cut <= e["commit_s"],
                "entropy": lambda e, bits=bound: e["entropy_bits"] >= bits - 1e-4,
                "commonest future": lambda e: e["top_share"] <= ensemble.TOP_SHARE + 1e-4,
                "futures": lambda e: e["accepted"] >= ensemble.MIN_ACCEPTED,
            }
        if spec.twin.ground_truth == spec.ground_truth:
            found.append(f"{spec.scenario_id}: the twin has the same answer")
        found += _broken(spec, rules)
    return found


def _broken(spec: SceneSpec, rules: Mapping[str, Callable[[Evidence], bool]]) -> list[str]:
    found = []
    for name, holds in rules.items():
        try:
            good = holds(spec.evidence)
        except KeyError as missing:
            found.append(f"{spec.scenario_id}: {name}: no evidence {missing}")
            continue
        if not good:
            found.append(f"{spec.scenario_id}: {name} does not hold")
    return found


def answerable_ill_posed(specs: Sequence[SceneSpec]) -> list[str]:
    """Records whose ill-posed question nothing refutes, or whose well-posed one something does."""
    found = []
    for spec in specs:
        family = get_family(spec.family)
        inventory = family.build(family.params_from(spec.params), Physics(**spec.physics)).inventory
        if refutation(spec.taxonomy, spec.ill_posed_question, inventory) is None:
            found.append(f"{spec.scenario_id}: nothing refutes {spec.ill_posed_question!r}")
        refuted = refutation(spec.taxonomy, spec.question, inventory)
        if refuted is not None:
            found.append(f"{spec.scenario_id}: the question {spec.question!r} reads as ill-posed: {refuted}")
    return found
