"""What errors about sites, gates and a pair's tokens say to do lets the same change, gate or extraction succeed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from tests.local_models import QUESTIONS, SYSTEM, ask, direction, model
from tests.mechanism.test_interventions import CELL, acting
from tests.mechanism.test_stages import STANDARD, entry, own, patch, study
from tests.remedies.remedied import remedied
from traps_pipeline import inside
from traps_pipeline.base.partitions import DATASETS, StatesCell
from traps_pipeline.benchmark.tables import VIDEOS, VideoRow
from traps_pipeline.mechanism import stages, steered_backend
from traps_pipeline.mechanism.deciding import conditions, fitted_gate
from traps_pipeline.mechanism.directions import vector_digest
from traps_pipeline.mechanism.hidden_states import Item, item_states
from traps_pipeline.mechanism.made_answers import MadeAnswers
from traps_pipeline.mechanism.probe_items import other_clip, probe_items
from traps_pipeline.mechanism.steered_backend import SteeredBackend
from traps_pipeline.mechanism.steering import wanted_steered
from traps_pipeline.mechanism.tables import HIDDEN_STATES
from traps_pipeline.models.local.capture import Pooling
from traps_pipeline.models.registry import ModelEntry
from traps_pipeline.storage.study import SteeringSettings
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
__all__ = ["entry", "own", "patch", "study"]  # fixtures


def test_a_head_is_named_with_its_site_and_its_dose() -> None:
    of, push = model("qwen3-vl"), inside.Direction(direction(model("qwen3-vl")), 2, gap=1.0)

    def applied(**about: Any) -> Callable[[], bool]:
        def apply() -> bool:
            with push.apply(of, **about):
                return True

        return apply

    remedied(
        applied(amount=1.0, head=1, site="mlp"),
        "head {} is one of a block's attention, not of its {}; give site attention",
        again=applied(amount=1.0, head=1, site="attention"),
    )
    remedied(
        applied(gaps=1.0, head=1, site="attention"),
        "class gaps are measured in the residual stream, not in a head; give amount",
        again=applied(amount=1.0, head=1, site="attention"),
    )
    weights = of.blocks[1].self_attn.o_proj.weight
    before = weights.detach().clone()
    try:
        with torch.no_grad():
            weights[:, :16] = 0  # head 0 writes nothing at all
        remedied(
            applied(amount=1.0, head=0, site="attention"),
            "head {} writes nothing along this direction; choose another head",
            again=applied(amount=1.0, head=1, site="attention"),
        )
    finally:
        with torch.no_grad():
            weights.copy_(before)


def test_settings_of_a_head_name_its_site_and_no_gaps() -> None:
    remedied(
        lambda: SteeringSettings(head=1, gaps=()),
        "head {}: heads are of attention; set site: attention",
        again=lambda: SteeringSettings(head=1, gaps=(), site="attention"),
        error=ValidationError,
    )
    remedied(
        lambda: SteeringSettings(head=1, site="attention"),
        "class gaps are measured in the residual stream, not in a head: set gaps and clamp to []",
        again=lambda: SteeringSettings(head=1, site="attention", gaps=(), clamp=()),
        error=ValidationError,
    )


def test_a_gate_has_more_pairs_and_states_of_a_token(own: Workspace) -> None:
    found = remedied(
        lambda: conditions(acting(own, when="mid", pairs=3), STANDARD),
        "a gate from {} needs both sides of {} scenarios (`probes.folds`), and has {} items; extract the hidden states "
        "of more pairs",
        again=lambda: conditions(acting(own, when="mid", pairs=2), STANDARD),
    )
    assert len(found) == 8  # four sources, two layers

    def pooled(pooling: str) -> None:
        changed = own.allow(mechanism=own.mechanism.model_copy(update={"pooling": pooling}))
        for dataset in DATASETS:
            cell = StatesCell(dataset, STANDARD)
            own.tables.write(HIDDEN_STATES, cell.partition, stages.extract_states(changed, cell)[0], {})

    pooled("visual")
    remedied(
        lambda: fitted_gate(own, STANDARD, source="one:occlusion", threshold="mid", layer=2),
        "these states are means over a part of the prompt ({}), which a prompt alone does not tell; "
        "set `pooling: last`",
        lambda: pooled("last"),
    )


def test_clips_of_a_pair_are_there_and_alike(own: Workspace) -> None:
    row = vars(probe_items(own, "occlusion")[0])
    videos = [VideoRow(**r) for r in own.tables.read(VIDEOS, {"category": "hidden"}).to_dict("records")]
    own.tables.write(VIDEOS, {"category": "hidden"}, [video for video in videos if video.side == "control"], {})
    remedied(
        lambda: other_clip(own, row),
        "{}: lacks a clip of its pair; materialize videos for {}",
        lambda: own.tables.write(VIDEOS, {"category": "hidden"}, videos, {}),
    )
    of = model("qwen3-vl")
    frames = np.random.default_rng(0).integers(90, 255, (4, 32, 64, 3)).astype(np.uint8)
    one = of.prompt(SYSTEM, QUESTIONS[1], frames, [0.0, 0.5, 1.0, 1.5])

    def states(pooling: Pooling) -> Callable[[], object]:
        about = {"system": SYSTEM, "question": QUESTIONS[1]}
        item = Item("one", "control", about, lambda: one, lambda: ask(of, QUESTIONS[1]))
        return lambda: item_states(of, item, one, pooling)

    remedied(
        states("changed"),
        "{}: its visual tokens cannot be compared with those of the pair's other clip (not as many, or pixels that do "
        "not come token by token); choose another pooling",
        again=states("visual"),
    )


def test_steered_positions_are_ones_that_prompts_have(
    own: Workspace, entry: ModelEntry, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = steered_backend.spans
    monkeypatch.setattr(
        steered_backend,
        "spans",
        lambda *about: real(*about) | {"stamps": np.zeros(about[1].n_tokens, bool)},  # a model that writes no times
    )
    along = {"standard": stages.saved_directions(own, STANDARD)}
    vectors = {vector_digest(v): v for of in along["standard"].values() for v in of.void}
    backend = SteeredBackend(entry, vectors, MadeAnswers(own.store, own.root / "made", 1), {})
    wanted = {
        part: [q.request for q in wanted_steered(acting(own, positions=part), entry, CELL, along["standard"], {})][-1:]
        for part in ("stamps", "question")
    }
    made = remedied(
        lambda: backend.generate(wanted["stamps"], lambda: False),
        "{}: its prompts have no {}; choose other steering.positions",
        again=lambda: backend.generate(wanted["question"], lambda: False),
    )
    assert len(made) == 1
