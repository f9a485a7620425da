"""The claims in the pocket's card: figures of a study, worked out by hand, and whether they tell models apart."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import pandas as pd
import pytest

from tests.build.controls import Made, frame
from tools.pocket.claims import CLAIMS, markdown
from tools.pocket.commands import MECHANISM
from tools.pocket.recipe import SHIPPED
from tools.pocket.seeds import Figure, read_seeds
from traps_pipeline.mechanism.mechanism_rows import STEERING_EFFECTS

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("folder", SHIPPED.values(), ids=[*SHIPPED])
def test_every_claim_is_measured_in_both_models(folder: Path) -> None:
    figures = read_seeds(folder / MECHANISM, Figure)
    assert {figure.claim for figure in figures} == {claim.name for claim in CLAIMS}


def test_figures_of_claims_by_hand() -> None:
    """Two voids, both answered, both encoded: the margin orders three of four pairs of a void and a control, whole
    abstentions one and a tie. Guided takes voids from 3 to 9 above controls. One cell is ahead of its null."""
    expected = {"unsaid": 1.0, "order": 0.25, "sentence": 0.625, "answer": 0.625, "lens": 6.0, "ahead": 1.0}
    expected |= {"gate": None, "risk": None}  # nothing was gated under standard
    values = {claim.name: claim.of(Made()) for claim in CLAIMS if claim.name in expected}
    assert values == {name: value if value is None else pytest.approx(value) for name, value in expected.items()}


class Steered(Made):
    """Controls of one dataset along its own directions from both prompts; `missing` answers say nothing."""

    @cached_property
    def effects(self) -> pd.DataFrame:
        along = {"regime": "guided", "source": "chaotic", "target": "chaotic", "layer": 3, "alpha": 40.0}
        rows = [along | {"side": "void", "directions": "guided"}, along | {"side": "void", "directions": "standard"}]
        for directions, abstained, n, missing, other in (
            ("guided", 3, 4, 1, {}),
            ("standard", 1, 1, 4, {}),
            ("standard", 5, 5, 0, {"layer": 1}),  # of the sweep, which has no voids
            ("guided", 0, 5, 0, {"alpha": 20.0}),
            ("guided", 0, 5, 0, {"source": "occlusion"}),
        ):
            counts = {"side": "control", "directions": directions, "abstained": abstained, "n": n, "n_missing": missing}
            rows.append(along | counts | other)
        return frame(STEERING_EFFECTS, *rows)


def test_one_dose_is_compared_along_directions_of_both_prompts() -> None:
    (followed,) = (claim for claim in CLAIMS if claim.name == "followed")
    assert followed.of(Steered()) == pytest.approx(3 / 5 - 1 / 5)


def test_a_stage_tells_models_apart_if_its_claim_holds_in_every_seed_of_one_and_in_none_of_the_other() -> None:
    (claim, *_) = CLAIMS

    def told(gap: list[float], no_gap: list[float]) -> str:
        of = [[Figure(n, "w", claim.name, value) for n, value in enumerate(values)] for values in (gap, no_gap)]
        lines = markdown(*of).splitlines()
        assert len(lines) == 3 and lines[2].startswith(f"| {claim.stage}: {claim.says} |")
        return lines[2].split(" | ")[-1].removesuffix(" |")

    bound, above, below = claim.bound, claim.bound + 0.1, claim.bound - 0.1
    assert told([bound, above], [below, below]) == "yes"
    assert told([above, below], [below]) == told([above], [below, bound]) == told([below], [below]) == "no"
    assert told([below, below], [above, bound]) == "the other way"
    assert claim.stage not in markdown([], [])  # a claim that was not measured has no row
