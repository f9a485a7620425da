"""Steering at other sites, at parts of the prompt and under a condition, through the stage: every answer is that of a
plain pass under `inside.Direction.apply`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.local_models import FAMILIES, QUESTIONS, SYSTEM, Family, direction, model, three_prompts
from tests.mechanism.study import make_study, register, tiny_entry
from traps_pipeline import inside
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism import stages, steering
from traps_pipeline.mechanism.deciding import conditions
from traps_pipeline.mechanism.directions import steered_scenarios
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.mechanism.mechanism_rows import DIRECTIONS, HIDDEN_STATES, PROBE_ITEMS, STEERING, SteeringRow
from traps_pipeline.mechanism.probe_items import probe_items
from traps_pipeline.mechanism.probing_versions import loaded_params, steering_version
from traps_pipeline.mechanism.steering import NO_STEERING, Strength, collect_steered, steered_request
from traps_pipeline.models.local.adapter import Prompt, load_local_model
from traps_pipeline.models.local.prefixes import PrefixMemory
from traps_pipeline.models.local.spans import spans
from traps_pipeline.models.prompts import system_prompt
from traps_pipeline.models.registry import ModelEntry
from traps_pipeline.protocol.cells import Extraction, StatesCell, SteeringCell
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.media import profile_digest, sample
from traps_pipeline.storage.study import ACTING, SteeringSettings
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow

STANDARD = Extraction("tiny", "standard")
CELL = SteeringCell.make("chaotic", "tiny", "standard", "guided")
each_family = pytest.mark.parametrize("family", FAMILIES)


@pytest.fixture(scope="module")
def entry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModelEntry]:
    with pytest.MonkeyPatch.context() as patch:
        made = tiny_entry(tmp_path_factory.mktemp("tiny") / "checkpoint")
        register(patch, made)
        yield made


@pytest.fixture(scope="module")
def study(entry: ModelEntry, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    workspace = make_study(tmp_path_factory.mktemp("study"))
    for dataset in ("occlusion", "chaotic"):
        workspace.tables.write(PROBE_ITEMS, {"dataset": dataset}, probe_items(workspace, dataset), {})
        cell = StatesCell(dataset, STANDARD)
        workspace.tables.write(HIDDEN_STATES, cell.partition, stages.extract_states(workspace, cell)[0], {})
    workspace.tables.write(DIRECTIONS, STANDARD.partition, stages.direction_rows(workspace, STANDARD), {})
    return workspace


def acting(workspace: Workspace, **settings: Any) -> Workspace:
    """The study with few doses, steered as the settings say."""
    few = {"alphas": (60.0,), "gaps": (), "signs": (), "nulls": None, "project_out": (1.0,)} | settings
    before = workspace.mechanism.steering
    assert before is not None
    checked = SteeringSettings.model_validate(before.model_dump() | few)
    return workspace.allow(mechanism=workspace.mechanism.model_copy(update={"steering": checked}))


def answers(workspace: Workspace, entry: ModelEntry) -> list[SteeringRow]:
    along = {"standard": stages.saved_directions(workspace, STANDARD)}
    ((_, made),) = collect_steered(workspace, entry, [CELL], along)
    return list(made.rows(STEERING))


def prompts(workspace: Workspace, entry: ModelEntry) -> dict[str, tuple[Prompt, dict[str, np.ndarray]]]:
    """By item, its prompt under the benchmark's guided prompt, and its parts."""
    of, system, found = load_local_model(entry), system_prompt("guided"), {}
    assert entry.media is not None
    for item in workspace.tables.read(ITEMS, {"dataset": "chaotic"}).to_dict("records"):
        shown = sample(workspace.resolve(item["clip"]), entry.media)
        prompt = of.prompt(system, item["question"], shown.frames, shown.times_s)
        found[item["item_id"]] = prompt, spans(of, prompt, system, item["question"])
    return found


@pytest.mark.parametrize(
    "settings",
    [
        {"site": "attention", "clamp": (-0.5,)},
        {"site": "attention", "head": 1},
        {"site": "mlp", "positions": "last"},
        {"positions": "last", "clamp": (2.0,)},
        {"positions": "last", "when": "mid"},
        {"when": "J", "gaps": (3.0,)},
    ],
)
def test_every_answer_of_the_stage_is_that_of_a_plain_model_under_the_same_change(
    study: Workspace, entry: ModelEntry, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = acting(study, **settings)
    of, along, asked = load_local_model(entry), stages.saved_directions(study, STANDARD), prompts(study, entry)
    gates, fired, differ = conditions(own, STANDARD), set[bool](), 0
    scores = {key: [gate.score(of, prompt) for prompt, _ in asked.values()] for key, gate in gates.items()}
    # Half-way over these prompts, so that some are steered and some are not.
    gates = {key: replace(gate, threshold=float(np.median(scores[key]))) for key, gate in gates.items()}
    monkeypatch.setattr(steering, "conditions", lambda *_: gates)
    rows = answers(own, entry)
    plain = {row.item_id: row.text for row in rows if row.kind == "none"}
    for row in rows:
        prompt, parts = asked[row.item_id]
        change: Any = nullcontext()
        if row.kind != "none":
            how = {"project out": "project out", "clamp": "clamp"}.get(row.unit, "add")
            sign = -1 if row.signs == "label" and row.side == "void" else 1
            amount = row.dose if how == "project out" else sign * row.alpha
            part = parts.get(settings.get("positions", ""))

            def positions(states: torch.Tensor, part: np.ndarray | None = part) -> torch.Tensor:
                if part is None or states.shape[1] != len(part):  # all; or what is generated
                    return torch.full(states.shape[:2], part is None)
                return torch.from_numpy(part).expand(states.shape[:2])

            gate = gates.get((row.source, row.layer))
            fired |= {gate.abstains(of, prompt)} if gate else set()
            change = inside.Direction(along[row.source].void[row.layer], row.layer).apply(
                of.network,
                amount,
                how=how,
                site=settings.get("site", "residual"),
                head=settings.get("head"),
                positions=positions,
                when=(gate.probe, gate.threshold) if gate else None,
            )
        with change:
            said = of.generate([prompt], 4)[0].text.strip()
        assert (row.text or "") == said
        differ += row.text != plain[row.item_id]
    assert differ > 0 and {row.layer for row in rows} == {0, 1, 2}
    assert fired == ({True, False} if "when" in settings else set())
    assert len({row.place for row in rows}) == 1


def test_the_gate_of_a_path_has_not_seen_what_is_steered(study: Workspace) -> None:
    own = acting(study, when="mid")
    gates = conditions(own, STANDARD)
    assert set(gates) == {(name, layer) for name in ("occlusion", "chaotic") for layer in (1, 2)}
    states = inside.load(own, "tiny", layer=2, datasets=["chaotic"])
    seen = ~states.items["scenario_id"].isin(
        steered_scenarios(sorted(set(states.items["scenario_id"])), 2, own.mechanism.seed)
    )
    left = states.where(seen.to_numpy())
    probe = inside.fit_probe(left.X, left.void)
    assert gates["chaotic", 2].probe.scores(states.X) == pytest.approx(probe.scores(states.X))
    assert conditions(study, STANDARD) == {}
    with pytest.raises(TrapsError, match="needs both sides of 2 scenarios"):
        conditions(acting(study, when="mid", pairs=3), STANDARD)


def test_keys_and_versions_of_the_papers_steering_are_as_they_were(study: Workspace, entry: ModelEntry) -> None:
    item = study.tables.read(ITEMS, {"dataset": "chaotic"}).to_dict("records")[0]
    push = Strength("chaotic", "void", 2, 8.0, "digest")
    paper, other = acting(study), acting(study, site="attention", head=1, positions="visual", when="mid")
    first, second = (
        steered_request(of, entry, item, CELL, strength, 4)
        for of, strength in ((paper, push), (other, replace(push, gate="made of")))
    )
    assert first.params["steering"] == {"direction": "digest", "layer": 2, "alpha": 8.0}
    more = {"site": "attention", "head": 1, "positions": "visual", "when": "mid", "gate": "made of"}
    assert second.params["steering"] == {**first.params["steering"], **more} and first.key != second.key
    plain = [steered_request(of, entry, item, CELL, NO_STEERING, 4).key for of in (paper, other)]
    assert plain[0] == plain[1]  # the model as it is, is one answer
    of_paper = paper.mechanism.steering
    assert of_paper is not None and entry.media is not None
    before = {name: v for name, v in of_paper.model_dump(mode="json").items() if name not in ACTING}
    chosen = [before, paper.mechanism.models["tiny"].model_dump(mode="json"), paper.mechanism.seed]
    chosen += [loaded_params(entry), profile_digest(entry.media), system_prompt("guided")]
    assert steering_version(paper, "tiny__standard__guided") == digest(chosen)[:16]
    assert steering_version(other, "tiny__standard__guided") != digest(chosen)[:16]


@each_family
@pytest.mark.parametrize(("site", "head"), [("residual", None), ("attention", None), ("attention", 3), ("mlp", None)])
def test_a_batch_resumed_where_it_may_be_has_the_answers_of_single_plain_passes(
    family: Family, site: Any, head: int | None
) -> None:
    """Prompts of three lengths, each steered at its question and last token; and block 1, below which is nothing."""
    of, rows = model(family), three_prompts(family)
    masks = tuple(
        (s := spans(of, prompt, SYSTEM, q))["question"] | s["last"] for prompt, q in zip(rows, QUESTIONS, strict=True)
    )
    plain = [one.tokens for one in of.generate(rows, 8)]
    for layer in (1, 3):
        hook = Steering(direction(of), layer, (400.0, -400.0, 90.0), (0.0, 0.0, 1.0), site, head, masks)
        assert hook.resumes_at == (layer if site == "residual" else layer - 1)
        alone = [of.generate([prompt], 8, steering=hook.rows([n]))[0] for n, prompt in enumerate(rows)]
        uncached = of.generate(rows, 8, steering=hook, use_cache=False)
        of.prefixes = PrefixMemory()
        with of.resuming():
            made = of.generate(rows, 8, steering=hook)
        assert [one.tokens for one in made] == [one.tokens for one in alone] == [one.tokens for one in uncached]
        assert [one.tokens for one in made] != plain
        assert of.prefixes.passes == (3 if hook.resumes_at > 0 else 0)


def test_settings_that_cannot_be_are_refused() -> None:
    for wrong, message in (
        ({"head": 1}, "heads are of attention; set site: attention"),
        ({"site": "attention", "head": 1}, r"set gaps and clamp to \[\]"),
        ({"site": "embeddings"}, "residual"),
        ({"positions": "panel"}, "visual"),
    ):
        with pytest.raises(ValueError, match=message):
            SteeringSettings.model_validate(wrong)
