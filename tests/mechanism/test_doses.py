"""Which doses a direction and its nulls are given: in alphas, in class gaps, up to so many lengths of a state."""

from __future__ import annotations

import numpy as np
import pytest

from traps_pipeline.mechanism.directions import Directions
from traps_pipeline.mechanism.steering import strengths
from traps_pipeline.storage.study import MechanismSettings


@pytest.mark.parametrize(
    ("gap", "doses", "null"),
    [
        (1.0, [("alpha", 3), ("gap", 0.5), ("gap", 1), ("gap", 2), ("gap", 4)], ("gap", 4)),
        (4.0, [("alpha", 3), ("gap", 0.5), ("gap", 1), ("gap", 2), ("gap", 4)], ("gap", 4)),  # 16 is twice the states
        (5.0, [("alpha", 3), ("gap", 0.5), ("gap", 1), ("gap", 2)], ("gap", 2)),
        (99.0, [("alpha", 3)], ("alpha", 3)),
    ],
)
def test_doses_in_gaps_end_at_the_cap_and_nulls_have_the_largest(
    gap: float, doses: list[tuple[str, float]], null: tuple[str, float]
) -> None:
    unit = np.eye(4, dtype=np.float32)[None, [0, 0, 0]]
    of = Directions({"void": unit, "isotropic": unit}, np.full(3, gap), np.full(3, 8.0))
    steering = {"alphas": [3], "signs": [], "nulls": {"kinds": ["isotropic"], "draws": 1}}
    settings = MechanismSettings.model_validate({"models": {"m": {"steering": 2, "centroid": 1}}, "steering": steering})
    given = strengths("chaotic", settings.models["m"], settings, {"chaotic": of})
    steered = {kind: [(s.unit, s.dose) for s, _ in given if s.kind == kind] for kind in ("void", "isotropic")}
    assert steered == {"void": doses, "isotropic": [null]}
    assert all(s.alpha == pytest.approx(s.dose * gap) for s, _ in given if s.unit == "gap")
