"""Baselines of probes: raw inputs that give a side away, the output margin, and the floor of noise."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from traps_pipeline.mechanism.baselines import noise_floor, raw_features, score_features
from traps_pipeline.mechanism.margin import is_abstention_start
from traps_pipeline.mechanism.probing import ProbeRun
from traps_pipeline.protocol.datasets import DATASETS, is_ill_posed, taxonomy_of
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.storage.study import ProbeSettings
from traps_pipeline.video.encode import encode

PAIRS = 12
SETTINGS = ProbeSettings(folds=3, resamples=100)


def items() -> pd.DataFrame:
    """Pairs of all datasets; the controls of a taxonomy's two datasets are one prompt."""
    rows = []
    for dataset in DATASETS:
        for number in range(PAIRS):
            for side in ("control", "void"):
                name = f"{taxonomy_of(dataset)}-{number:02d}"
                key = f"{name} {'shared' if side == 'control' else dataset}"
                asked = "What does it weigh?" if side == "void" and is_ill_posed(dataset) else "Does it end left?"
                rows.append((dataset, name, side, "sub", key, asked))
    frame = pd.DataFrame(rows, columns=["dataset", "scenario_id", "side", "sub_scenario", "states_key", "question"])
    return frame.assign(item_id=frame["dataset"] + frame["scenario_id"] + frame["side"], width=200)


def run_of(frame: pd.DataFrame) -> ProbeRun:
    return ProbeRun(frame, lambda dataset, layer: np.empty(0), 1, 0, SETTINGS, 7)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A control of twelve frames and a void of eight, equal in their first ones."""
    folder = tmp_path_factory.mktemp("clips")
    for name, count in (("control", 12), ("void", 8)):
        encode([np.full((48, 64, 3), 40 + 10 * i, np.uint8) for i in range(count)], folder / name, 4)
    return lambda clip: folder / clip


def test_a_cut_gives_itself_away_by_length_and_stamps(
    clips: Callable[[str], Path],
) -> None:
    frame = items()
    frame = frame.loc[frame["dataset"].str.startswith("chaotic")].reset_index(drop=True)
    cut = (frame["dataset"] == "chaotic") & (frame["side"] == "void")
    frame = frame.assign(clip=np.where(cut, "void", "control"))
    by_dataset = dict(iter(frame.groupby("dataset", sort=False)))
    made = raw_features(by_dataset, MediaSpec(profile="frames", uniform=2), clips)
    own, run = {}, run_of(frame)
    for name, features in made.items():
        rows = score_features(run, features)
        own[name] = {
            r["source"]: r["value"] for r in rows if r["analysis"] == "held_out" and r["source"] == r["target"]
        }
    assert own["length"]["chaotic"] == own["time stamps"]["chaotic"] == 1.0
    assert own["first frame"]["chaotic"] == own["question words"]["chaotic"] == 0.5
    assert own["all frames"]["chaotic"] == 1.0  # the last frame of the whole clip is brighter
    assert own["question words"]["chaotic_ill_posed"] == 1.0 and own["length"]["chaotic_ill_posed"] == 0.5
    assert made["length"]["chaotic"][:2].ravel().tolist() == [2.75, 1.75]  # the last of 12 and of 8 frames, 4 a second


def test_noise_shows_what_shared_controls_give_and_that_held_out_scenarios_take_it_away() -> None:
    rows = pd.DataFrame(noise_floor(run_of(items()), seed=3, draws=4))
    rows = rows.set_index(["analysis", "source", "target", "scope"]).sort_index()
    assert rows.loc[("transfer", "chaotic", "chaotic_ill_posed", "all"), "value"] > 0.9
    floor = rows.loc[("held_out", "chaotic", "chaotic_ill_posed", "all")]
    assert abs(floor["value"] - 0.5) < 0.2 and 0 < floor["spread"] < 0.2
    assert abs(rows.loc[("transfer", "chaotic", "occlusion", "all"), "value"] - 0.5) < 0.2


@pytest.mark.parametrize(
    ("token", "begins"),
    [
        ("I", True), (" I", True), ("Cannot", True), ("I don't know: this cannot be determined from the video.", True),
        ("I don\u2019t know", True), ("In", False), ("The answer is: ", False), ("U", False), ("", False),
    ],
)  # fmt: skip
def test_tokens_that_begin_an_abstention_are_known_by_their_text(token: str, begins: bool) -> None:
    assert is_abstention_start(token) == begins
