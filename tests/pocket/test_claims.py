"""The claims in the pocket's card: figures of a study, worked out by hand, and whether they hold in its controls."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import pandas as pd
import pytest

from tests.build.controls import Made, frame
from tools.pocket.claims import markdown
from tools.pocket.commands import MECHANISM
from tools.pocket.recipe import SHIPPED
from tools.pocket.seeds import Figure, read_seeds
from traps_pipeline.mechanism.mechanism_rows import STEERING_EFFECTS
from traps_pipeline.report.tables.claims import CLAIMS, claim_frame

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("folder", SHIPPED.values(), ids=[*SHIPPED])
def test_every_claim_is_measured_in_both_models(folder: Path) -> None:
    figures = read_seeds(folder / MECHANISM, Figure)
    measured = {claim.name for claim in CLAIMS} - {"interaction"}  # the card's study asks no two events
    assert {figure.claim for figure in figures if figure.subject == "model"} == measured


def test_figures_of_claims_by_hand() -> None:
    """Two voids, both answered, both encoded, and no control is: the share is 1. States order all four pairs of a void
    and a control, whole abstentions one and a tie. Guided takes voids from 3 to 9 above controls. States have .9, the
    best rival .7, the logits .65. The gate is on states and on words alike, under guided alone."""
    expected = {"unexpressed": 1.0, "sentence": 0.625, "lens": 6.0, "lead_visual": 0.2, "output": 0.25, "residual": 0.8}
    found = claim_frame(Made()).set_index("claim")["in_model"]
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    assert found[["gate", "lead_textual", "ahead", "direction"]].isna().all()


class Steered(Made):
    """Controls of one dataset along its own directions from both prompts; `missing` answers say nothing."""

    @cached_property
    def effects(self) -> pd.DataFrame:
        along = {"regime": "guided", "source": "chaotic", "target": "chaotic", "layer": 3, "alpha": 40.0}
        rows = [along | {"side": "void", "directions": name, "abstention": 0.0} for name in ("guided", "standard")]
        for directions, abstained, n, missing, other in (
            ("guided", 3, 4, 1, {}),
            ("standard", 1, 1, 4, {}),
            ("standard", 5, 5, 0, {"layer": 1}),  # of the sweep, which has no voids
            ("guided", 0, 5, 0, {"alpha": 20.0}),
            ("guided", 0, 5, 0, {"source": "occlusion"}),
        ):
            counts = {"side": "control", "directions": directions, "abstention": abstained / (n + missing)}
            rows.append(along | counts | other)
        return frame(STEERING_EFFECTS, *rows)


def test_one_dose_is_compared_along_directions_of_both_prompts() -> None:
    (followed,) = (claim for claim in CLAIMS if claim.name == "followed")
    assert followed.of(Steered(), "m", "model") == pytest.approx(3 / 5 - 1 / 5)


def test_the_card_holds_a_claim_in_the_worst_seed_of_the_model_and_the_best_of_its_controls() -> None:
    (claim,) = (claim for claim in CLAIMS if claim.name == "output")
    bound, above, below = claim.bound, claim.bound + 0.1, claim.bound - 0.1

    def printed(gap: dict[str, list[float]], no_gap: list[float]) -> str:
        figures = [Figure(n, "w", claim.name, s, value) for s, values in gap.items() for n, value in enumerate(values)]
        others = [Figure(n, "w", claim.name, "model", value) for n, value in enumerate(no_gap)]
        lines = markdown(figures, others).splitlines()
        assert len(lines) == 3 and lines[2].startswith(f"| {claim.says} | {claim.holds_if} | ")
        return lines[2].split(" | ")[-1].removesuffix(" |")

    assert printed({"model": [bound, above], "random_0": [below], "placebo": [below]}, [below, below]) == "holds"
    assert printed({"model": [bound, below]}, [below]) == "model below bound"
    assert printed({"model": [above], "random_0": [below], "random_1": [below, bound]}, []) == "holds in random 1 too"
    assert printed({"model": [above]}, [below, bound]) == "holds in pocket, no gap too"
    assert printed({"model": [above]}, []) == "no control"
    assert claim.says not in markdown([], [])  # a claim that was not measured has no row
