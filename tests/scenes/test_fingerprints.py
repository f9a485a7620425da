"""Every family still gives, bit for bit, the worlds, draws, words and answers that were frozen for it.

One family alone:
`pytest tests/scenes/test_fingerprints.py -k "bounce-"`.
"""

from __future__ import annotations

import pytest

from tests.scenes import fingerprints
from traps_pipeline.scenes.family_registry import family_names

pytestmark = pytest.mark.slow
FROZEN = fingerprints.frozen()
HERE = fingerprints.versions()
LIBRARIES = ("mujoco", "numpy", "machine")
# On a machine whose elementary functions differ in the last bit, one family's compiled model does too.
ROUNDED = {"launch": {"model"}} if FROZEN["versions"]["arithmetic"] != HERE["arithmetic"] else {}

same_libraries = pytest.mark.skipif(
    any(FROZEN["versions"][name] != HERE[name] for name in LIBRARIES),
    reason=f"digests were frozen with {FROZEN['versions']}, here it is {HERE}",
)
families = pytest.mark.parametrize("name", sorted(FROZEN["families"]), ids=lambda name: f"{name}-")


def differing(name: str, records: list[str]) -> list[str]:
    """Parts of records that differ from what was frozen: '<scenario id>: model, outcome'."""
    found = []
    for scenario_id in records:
        then, now = (
            FROZEN["families"][name]["records"][scenario_id].split(),
            fingerprints.of_record(scenario_id).split(),
        )
        parts = {part for part, a, b in zip(("model", "scene", "outcome", "twins"), then, now, strict=True) if a != b}
        parts -= ROUNDED.get(name, set())
        if parts:
            found.append(f"{scenario_id}: {', '.join(sorted(parts))}")
    return found


def test_every_released_record_has_a_frozen_digest() -> None:
    frozen = {name: sorted(family["records"]) for name, family in FROZEN["families"].items()}
    released = {name: fingerprints.records_of(name) for name in family_names()}
    assert frozen == {name: records for name, records in released.items() if records}
    assert sum(map(len, frozen.values())) == 702


@same_libraries
@families
def test_draws_and_words_of_300_seeds_are_as_frozen(name: str) -> None:
    frozen = FROZEN["families"][name]
    assert fingerprints.of_family(name) == {part: frozen[part] for part in ("constants", "draws")}


@same_libraries
@families
def test_all_released_worlds_are_built_as_frozen(name: str) -> None:
    assert differing(name, fingerprints.records_of(name)) == []
