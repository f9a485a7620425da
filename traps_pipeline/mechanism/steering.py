"""Steer models (docs/spec.md 8): answers, their generation, and votes on them.

A steered answer is a request like any other, so it goes through the same ledger: its key holds the direction's digest,
the layer and the signed alpha, beside the prompt, the clip and the checkpoint. At alpha 0 the key holds none of the
three, so that all directions share one answer. The two datasets of a taxonomy have the same control items, and share
their answers too; so do two sign policies that add the same.

Doses are given as alphas, as in the paper, and in units of the class gap, since one alpha is a large step in one model
and none in another. Nulls are steered at every alpha and at the largest gap, beside the dataset's own direction.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.judging.panel import Ballot, ask_judges, judged_answers, tasks_for, vote_columns, vote_requests
from traps_pipeline.mechanism.degeneracy import degeneracy
from traps_pipeline.mechanism.directions import Directions, steered_scenarios, vector_digest
from traps_pipeline.mechanism.mechanism_rows import STEERING, SteeringRow, SteeringVoteRow
from traps_pipeline.mechanism.probing_versions import loaded_params
from traps_pipeline.mechanism.steered_backend import SteeredBackend
from traps_pipeline.mechanism.transfer_paths import sources_of
from traps_pipeline.models.asking.answers import Question
from traps_pipeline.models.asking.ask import SettledCell, collect_outcomes
from traps_pipeline.models.asking.participants import Row, call_time_columns
from traps_pipeline.models.registry.entries import Entry, ModelEntry
from traps_pipeline.models.registry.judges import JudgeEntry, load_panel
from traps_pipeline.models.registry.prompts import system_prompt
from traps_pipeline.models.request import Request
from traps_pipeline.protocol.cells import SteeringCell
from traps_pipeline.protocol.datasets import SIDES, taxonomy_of
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.study import Layers, MechanismSettings, SteeringSettings
from traps_pipeline.storage.workspace import Workspace

UNSTEERED = "none"  # source and kind if alpha is 0
BY_LABEL = "label"  # the paper's sign policy, which knows the side of each item


@dataclass(frozen=True)
class Strength:
    """A void direction and the strength at which it is added to hidden states.

    alpha has no sign: `signs` says on which side alpha times the direction is added and on which it is subtracted.
    dose: in its unit, one of DoseUnit.
    """

    source: str
    kind: str
    layer: int
    alpha: float
    digest: str | None = None
    relative: float | None = None
    draw: int = 0
    unit: str = "alpha"
    dose: float = 0.0
    signs: str = BY_LABEL

    def signed_alpha(self, side: str) -> float:
        """Return alpha with the sign that the direction has on a side."""
        return sign_of(self.signs, side) * self.alpha


def sign_of(signs: str, side: str) -> int:
    """Return 1 if a policy adds the direction on a side, -1 if it subtracts it."""
    return {"plus": 1, "minus": -1}.get(signs, 1 if side == "control" else -1)


NO_STEERING = Strength(UNSTEERED, UNSTEERED, 0, 0.0, None, 0.0)


@dataclass(frozen=True)
class SteeredQuestion(Question):
    """The call that asks a steered model about an item."""

    strength: Strength


# --- which answers ----------------------------------------------------------------------------------------------------


def strengths(
    target: str, layers: Layers, settings: MechanismSettings, directions: Mapping[str, Directions]
) -> list[tuple[Strength, tuple[str, ...]]]:
    """Return every strength at which a target is steered, each with the sides that are steered so.

    These are every path into the target whose source has a direction, the random and shuffled directions of that
    source, and the sweep over layers (along the target's own direction, only on controls). directions: by source.
    Raises TrapsError for a layer that does not exist, and if no source has a direction.
    """
    steering = settings.steering
    assert steering is not None, "an experiment without steering has no steering cells"
    pairs: list[tuple[Strength, tuple[str, ...]]] = [(NO_STEERING, SIDES)]
    plan = _plan(target, layers, steering, directions)
    if not plan:
        raise TrapsError(f"no direction leads to {target}; materialize hidden_states and directions first")
    for row in plan:
        vectors, layer = directions[row.source], row.layer
        if row.kind not in vectors.vectors or row.draw >= len(vectors.vectors[row.kind]):
            raise TrapsError(
                f"the directions of {row.source} have no {row.kind} draw {row.draw}; materialize directions again"
            )
        vector = vectors.vectors[row.kind][row.draw][_in_range(layer, vectors)]
        if not vector.any():
            raise TrapsError(
                f"the {row.kind} direction of {row.source} at layer {layer} is zero, since the sides do not differ "
                "there; name another layer in the experiment and in study.yaml"
            )
        for unit, dose in _doses_within(row, vectors, layer, steering.cap):
            alpha = dose * float(vectors.gaps[layer]) if unit == "gap" else dose
            relative = float(alpha / vectors.residual_norms[layer]) if vectors.residual_norms[layer] > 0 else None
            along = (row.source, row.kind, layer, alpha, vector_digest(vector), relative)
            pairs.append((Strength(*along, row.draw, unit, dose, row.signs), row.sides))
    return pairs


Dose = tuple[str, float]  # unit and number


def _doses_within(row: _Planned, of: Directions, layer: int, cap: float) -> Sequence[Dose]:
    """Return the doses of a direction, without those in class gaps beyond `cap` control states."""
    longest = cap * float(of.residual_norms[layer]) * (1 + 1e-9)
    within = [(unit, dose) for unit, dose in row.doses if unit == "alpha" or dose * float(of.gaps[layer]) <= longest]
    return _doses_of(row.kind, within)


def _doses_of(kind: str, doses: Sequence[Dose]) -> Sequence[Dose]:
    """Return the doses of a kind of direction: a null has those that claims read, every alpha and the largest gap."""
    gaps = [dose for dose in doses if dose[0] == "gap"]
    return doses if kind == "void" else [*(dose for dose in doses if dose[0] != "gap"), *gaps[-1:]]


class _Planned(NamedTuple):
    """A direction to steer along, with sides and doses."""

    source: str
    kind: str
    draw: int
    layer: int
    signs: str
    sides: tuple[str, ...]
    doses: tuple[Dose, ...]


def _plan(target: str, layers: Layers, steering: SteeringSettings, sources: Container[str]) -> list[_Planned]:
    """Return all paths into a target from these sources; along its own direction also signs, nulls and the sweep."""
    alphas: tuple[Dose, ...] = tuple(("alpha", float(alpha)) for alpha in steering.alphas)
    doses: tuple[Dose, ...] = (*alphas, *(("gap", float(gap)) for gap in steering.gaps))
    steered_layer = layers.steering
    plan = [_Planned(source, "void", 0, steered_layer, BY_LABEL, SIDES, doses) for source in sources_of(target)]
    plan += [_Planned(target, "void", 0, steered_layer, signs, SIDES, doses) for signs in steering.signs]
    if steering.nulls:
        draws = product(steering.nulls.kinds, range(steering.nulls.draws))
        plan += [_Planned(target, kind, draw, steered_layer, BY_LABEL, SIDES, doses) for kind, draw in draws]
    sweep = [layer for layer in layers.sweep if layer != steered_layer]
    plan += [_Planned(target, "void", 0, layer, BY_LABEL, ("control",), alphas) for layer in sweep]
    return [row for row in plan if row.source in sources]


def count_answers(
    settings: MechanismSettings, model: str, datasets: Sequence[str], scenarios: Mapping[str, int]
) -> dict[str, Counter[str]]:
    """Return the numbers of steered answers, each once, by inference regime, then by side."""
    steering = settings.steering
    if steering is None:
        return {}
    cells = set[tuple[Any, ...]]()
    for target, side in product(datasets, SIDES):
        owner = taxonomy_of(target) if side == "control" else target
        cells.add((owner, side, UNSTEERED))
        for row in _plan(target, settings.models[model], steering, datasets):
            if side in row.sides:
                along = (owner, side, row.source, row.kind, row.draw, row.layer, sign_of(row.signs, side))
                cells |= {
                    (*along, *combination)
                    for combination in product(steering.direction_regimes, _doses_of(row.kind, row.doses))
                }
    answers = Counter[str]()
    for cell in cells:
        source, taxonomy = str(cell[2]), taxonomy_of(str(cell[0]))
        is_own_direction = (
            source != UNSTEERED and taxonomy_of(source) == taxonomy
        )  # along a direction of its own scenarios
        n_scenarios = scenarios.get(taxonomy, 0) - (steering.direction_pairs(source) if is_own_direction else 0)
        answers[cell[1]] += max(0, min(steering.pairs, n_scenarios))
    return dict.fromkeys(steering.inference_regimes, answers)


def _in_range(layer: int, directions: Directions) -> int:
    if not 1 <= layer < directions.n_layers:
        raise TrapsError(
            f"mechanism.models: layer {layer} is out of range, blocks 1 to {directions.n_layers - 1} can be steered"
        )
    return layer


def wanted_steered(
    workspace: Workspace, entry: ModelEntry, cell: SteeringCell, directions: Mapping[str, Directions]
) -> list[SteeredQuestion]:
    """Return a cell's calls, grouped by prompt so that answers share a clip."""
    settings = workspace.mechanism
    assert settings.steering is not None, "an experiment without steering has no steering cells"
    items = workspace.tables.read(ITEMS, {"dataset": cell.dataset})
    scenarios = steered_scenarios(sorted(set(items["scenario_id"])), settings.steering.pairs, settings.seed)
    rows = items.loc[items["scenario_id"].isin(scenarios)].to_dict("records")
    plan = strengths(cell.dataset, settings.models[entry.id], settings, directions)
    max_tokens = settings.steering.max_new_tokens
    return [
        SteeredQuestion(steered_request(unsteered, str(item["side"]), strength), item, strength)
        for item in rows
        for unsteered in [unsteered_request(workspace, entry, item, cell, max_tokens)]
        for strength, sides in plan
        if item["side"] in sides
        and (strength.source == UNSTEERED or item["scenario_id"] not in directions[strength.source].scenarios)
    ]


def unsteered_request(
    workspace: Workspace, entry: ModelEntry, item: Mapping[str, Any], cell: SteeringCell, max_new_tokens: int
) -> Request:
    """Return the call at alpha 0: full benchmark prompt, greedy decoding, precision of extraction."""
    assert entry.media is not None, "local entries have media"
    clip = workspace.resolve(item["clip"])
    media = workspace.media.prepare(clip, item["media_digest"], entry.media)
    return Request(
        participant=entry.id,
        endpoint=entry.backend,
        params=loaded_params(entry) | {"do_sample": False, "max_new_tokens": max_new_tokens, "steering": None},
        system=system_prompt(cell.evaluation.regime),
        user=item["question"],
        about={"item_id": ledger_item_id(item), "model": entry.id, "regime": cell.evaluation.regime},
        media=clip,
        sent=media,
        media_digest=media.sha256,
    )


def steered_request(unsteered: Request, side: str, strength: Strength) -> Request:
    """Return the call at a strength, whose key holds what is added to the states."""
    if not strength.alpha:
        return unsteered
    added = {"direction": strength.digest, "layer": strength.layer, "alpha": strength.signed_alpha(side)}
    return replace(unsteered, params={**unsteered.params, "steering": added})


def ledger_item_id(item: Mapping[str, Any]) -> str:
    """Return the id of an item in the ledger; a taxonomy's datasets share the ids of controls."""
    dataset = taxonomy_of(item["dataset"]) if item["side"] == "control" else item["dataset"]
    return f"{dataset}:{item['scenario_id']}:{item['side']}"


# --- generating them --------------------------------------------------------------------------------------------------


def collect_steered(
    workspace: Workspace,
    entry: ModelEntry,
    cells: Sequence[SteeringCell],
    directions: Mapping[str, Mapping[str, Directions]],
) -> Iterator[tuple[SteeringCell, StageOutput]]:
    """Generate the missing answers; yield the STEERING rows of each finished cell.

    directions: by VQA prompt, then by source. One process at a time writes the answers of an evaluation.
    """
    vectors = {
        vector_digest(vector): vector
        for prompt_directions in directions.values()
        for group in prompt_directions.values()
        for kind in group.vectors
        for draw in group.vectors[kind]
        for vector in draw
    }

    def calls(cell: SteeringCell) -> list[SteeredQuestion]:
        return wanted_steered(workspace, entry, cell, directions[cell.directions])

    def finish(settled: SettledCell[SteeringCell, SteeredQuestion]) -> tuple[SteeringCell, StageOutput]:
        answers = settled.answered()
        unsteered_texts = {q.item["item_id"]: row["text"] for q, row in answers if q.strength.kind == UNSTEERED}
        return settled.output(partial(_steering_row, unsteered_texts))

    def make(entry: Entry) -> SteeredBackend:
        return SteeredBackend(entry, vectors)

    yield from collect_outcomes(workspace, "steering", workspace.answers, [entry], cells, calls, finish, make)


def _steering_row(
    plain: Mapping[str, str | None], cell: SteeringCell, question: SteeredQuestion, row: Row
) -> SteeringRow:
    item, strength = question.item, question.strength
    return SteeringRow(
        **cell.partition,
        **{name: item[name] for name in ("item_id", "scenario_id", "side", "benchmark_version")},
        **{name: row[name] for name in ("outcome", "text", "served_model", "completion_tokens")},
        **call_time_columns(row),
        **{name: getattr(strength, name) for name in ("source", "kind", "draw", "layer", "unit", "dose", "signs")},
        alpha=strength.alpha,
        alpha_relative=strength.relative,
        degenerate=degeneracy(row["text"], row["outcome"], plain.get(item["item_id"])),
        direction_digest=strength.digest,
        request_key=row["key"],
    )


# --- the panel's votes ------------------------------------------------------------------------------------------------


def collect_steering_votes(
    workspace: Workspace, cells: Sequence[SteeringCell]
) -> Iterator[tuple[SteeringCell, StageOutput]]:
    """Ask the panel about steered answers; yield STEERING_VOTES of finished cells."""
    panel = load_panel(workspace.study.panel)
    calls = partial(wanted_steering_ballots, workspace, panel)
    yield from ask_judges(workspace, "steering_votes", panel, cells, calls, lambda settled: settled.output(_vote_row))


def wanted_steering_ballots(workspace: Workspace, panel: Sequence[JudgeEntry], cell: SteeringCell) -> list[Ballot]:
    """Return the calls for every vote on the steered answers of a cell."""
    ballots = []
    for answer, item in judged_answers(workspace, STEERING, cell):
        control_item = item | {"item_id": ledger_item_id(answer)}
        answer_row = item | answer
        for task in tasks_for(answer["side"]):
            for request in vote_requests(panel, task, cell, control_item, answer["text"]):
                subject = {**request.about, "steered": answer["request_key"]}
                ballots.append(Ballot(replace(request, about=subject), answer_row, task))
    return ballots


def _vote_row(cell: SteeringCell, ballot: Ballot, row: Row) -> SteeringVoteRow:
    columns = ("source", "kind", "draw", "layer", "unit", "dose", "signs", "alpha", "item_id", "side")
    item_columns = {name: ballot.item[name] for name in (*columns, "benchmark_version")}
    vote = ballot.vote(row)
    correct = vote.decision if ballot.task == "correctness" else None
    return SteeringVoteRow(**cell.partition, **item_columns, **vote_columns(ballot, vote, row), correct=correct)
