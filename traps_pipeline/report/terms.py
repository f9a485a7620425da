"""Titles, marks and sides by which tables, figures and pages speak of the same things."""

from __future__ import annotations

from traps_pipeline.scoring.tables import INCOMPLETE_BELOW

TITLES = {
    "overall": "Overall",
    "occlusion": "Occlusion",
    "occlusion_ill_posed": "Occlusion, ill-posed",
    "chaotic": "Chaotic",
    "chaotic_ill_posed": "Chaotic, ill-posed",
}
# The side whose items a share is of.
SIDE_OF = {"acc": "control", "false_abs": "control", "abs_rec": "void"}
ENOUGH = f"{100 * INCOMPLETE_BELOW:g} %"
MISSING_MARK = "†"
INCOMPLETE_MARK = "‡"
MARKS = {
    MISSING_MARK: "some items have no answer or no majority; shares rest on the others",
    INCOMPLETE_MARK: f"incomplete: fewer than {ENOUGH} of items answered",
}
