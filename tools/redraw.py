"""Redraw released records for a new look or a new rule.

A record of an occlusion family is drawn again from the number of its draw (`draw_again`), which takes seconds. Where
the record cost thousands of rollouts, and its new look moves neither camera nor occluder, the worlds stay and only what
pixels say is measured again (`redraw_looks`). Either way the record is the one that `sample_family` would draw now;
run `traps benchmark certify` afterwards.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from traps_pipeline.base.files import write_text
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.scenes.certification.certificates import WORDS, certificates_for, pair_of
from traps_pipeline.scenes.draw.resolve import Resolved, json_values
from traps_pipeline.scenes.draw.sample import (
    Draw,
    Tally,
    ill_posed_for,
    load_tallies,
    record_line,
    rejection_kind,
    save_tallies,
    try_draw,
)
from traps_pipeline.scenes.family_registry import family_digest, get_family
from traps_pipeline.scenes.parts.look import Look, look_of_draw
from traps_pipeline.scenes.physics.kit import params_to_dict
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory, save_trajectory

# Parts of a look that move neither camera nor occluder.
STILL = ("floor", "pale-floor", "light", "panel", "material", "bystanders")

_Job = tuple[SceneSpec, Path, Tally]  # a record, the folder of trajectories and how its family was drawn


def draw_again(
    released: Path,
    name: str,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
    only: Collection[str] | None = None,
) -> dict[str, str]:
    """Redraw a family's records, or some ids, by the current looks and rules.

    Ids and ill-posed questions stay. Takes out those that are rejected now, so that `sample_family` fills their places,
    and returns the reasons by id.
    """
    return _rewrite(released, name, _draw_record_again, workers, report, only)


def take_out(released: Path, reasons: Mapping[str, str]) -> None:
    """Remove records and trajectories by id, and count the reasons in `draws.json`.

    The next `sample_family` with the same seed and count fills their places. Raises KeyError for an unknown id.
    """
    tallies = load_tallies(released)
    for family in sorted({scenario_id.rpartition("-")[0] for scenario_id in reasons}):
        lines = released / f"{family}.jsonl"
        records = {json.loads(line)["scenario_id"]: line for line in lines.read_text("utf-8").splitlines()}
        for scenario_id in [id_ for id_ in reasons if id_.rpartition("-")[0] == family]:
            del records[scenario_id]
            tallies[family].rejected[reasons[scenario_id]] += 1
            (released / "trajectories" / f"{scenario_id}.npz").unlink()
        write_text(lines, "".join(f"{line}\n" for line in records.values()))
    save_tallies(released, tallies)


def redraw_looks(
    released: Path, name: str, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> dict[str, str]:
    """Give a family's records the look of their draw, and measure their pixels again.

    All parts of the look must be in STILL. Takes out and returns rejected records as `draw_again` does.
    """
    looks = get_family(name).looks
    assert set(looks) <= set(STILL), f"{name}: looks in {', '.join(looks)}, of which some move the camera"
    return _rewrite(released, name, _redraw_look, workers, report)


def redraw_questions(released: Path, name: str) -> list[str]:
    """Replace ill-posed questions that lose the certificate `words`; return the ids."""
    seed, changed_ids = load_tallies(released)[name].seed, list[str]()
    lines = (released / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    records = {spec.scenario_id: spec for spec in map(SceneSpec.model_validate_json, lines)}
    texts = Counter(spec.ill_posed_question for spec in records.values())
    for spec in list(records.values()):
        pair = pair_of(spec, *(np.empty((0, 0)),) * 2)  # the words are measured without a trajectory
        if WORDS.failure(WORDS.measured(pair), pair.claim) is not None:
            texts[spec.ill_posed_question] -= 1
            question = ill_posed_for(spec, seed, texts, len(records))
            texts[question] += 1
            records[spec.scenario_id] = spec.model_copy(update={"ill_posed_question": question})
            changed_ids.append(spec.scenario_id)
    write_text(released / f"{name}.jsonl", "".join(map(record_line, records.values())))
    return changed_ids


def _rewrite(
    released: Path,
    name: str,
    change: Callable[[_Job], Resolved | str],
    workers: int | None,
    report: Callable[[str], None],
    only: Collection[str] | None = None,
) -> dict[str, str]:
    """Change records of a family, take out those rejected, and return reasons by id."""
    tally, rejections = load_tallies(released)[name], dict[str, str]()
    lines = (released / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    records = {spec.scenario_id: spec for spec in map(SceneSpec.model_validate_json, lines)}
    chosen_ids = [id_ for id_ in records if only is None or id_ in only]
    jobs = [(records[id_], released / "trajectories", tally) for id_ in chosen_ids]
    for n_finished, ((spec, folder, _), result) in enumerate(run_in_order(change, jobs, workers), start=1):
        if isinstance(result, str):
            rejections[spec.scenario_id] = result
        else:
            save_trajectory(folder, spec.scenario_id, result.worlds)
            records[spec.scenario_id] = result.spec
        report(f"{spec.scenario_id}: {rejections.get(spec.scenario_id, 'written again')}; {n_finished} of {len(jobs)}")
    write_text(released / f"{name}.jsonl", "".join(map(record_line, records.values())))
    tallies = load_tallies(released)
    tallies[name] = replace(tallies[name], file=family_digest(name), look=sorted(get_family(name).looks))
    save_tallies(released, tallies)
    take_out(released, {id_: rejection_kind(reason) for id_, reason in rejections.items()})
    return rejections


def _draw_record_again(job: _Job) -> Resolved | str:
    """Return today's result of a record's draw under its old names, or a rejection."""
    spec, _, tally = job
    looks = tuple(sorted(get_family(spec.family).looks))
    result = try_draw(Draw(spec.family, tally.seed, spec.seed, frozenset(), looks, tally.difficulty))
    if isinstance(result, str):
        return result
    worlds = [
        {field: value for field, value in world.params.items() if field != "look"} for world in (spec, result.spec)
    ]
    if worlds[0] != worlds[1]:
        return "its draw gives another scene"
    names = {"scenario_id": spec.scenario_id, "ill_posed_question": spec.ill_posed_question}
    return Resolved(result.spec.model_copy(update=names), result.qpos, result.twin)


def _redraw_look(job: _Job) -> Resolved | str:
    """Return a record with the look of its draw, or the certificate it then loses."""
    spec, folder, tally = job
    family, path = get_family(spec.family), folder / f"{spec.scenario_id}.npz"
    look = look_of_draw(tally.seed, spec.family, spec.seed, sorted(family.looks))
    qpos = load_trajectory(path, spec.trajectory_sha256)
    twin = load_trajectory(path, spec.twin.trajectory_sha256, "twin")
    result = with_look(spec, look, qpos, twin)
    return result if isinstance(result, str) else Resolved(result, qpos, twin)


def with_look(spec: SceneSpec, look: Look | None, qpos: np.ndarray, twin: np.ndarray) -> SceneSpec | str:
    """Return a record under a look in STILL, or the certificate it then loses."""
    family = get_family(spec.family)
    params = json_values(params_to_dict(replace(family.params_from(spec.params), look=look)))
    twin_params = spec.twin.params
    if twin_params is not None:
        twin_params = json_values(params_to_dict(replace(family.params_from(twin_params), look=look)))
    record = spec.model_copy(update={"params": params, "twin": spec.twin.model_copy(update={"params": twin_params})})
    pair, evidence = pair_of(record, qpos, twin), dict(spec.evidence)
    for certificate in certificates_for(spec.void_kind):
        if any(number.of_futures for number in certificate.numbers):
            continue  # thousands of rollouts, of which no picture is drawn
        try:
            measured = certificate.measured(pair)
        except Rejected as rejected:
            return f"{certificate.name}: {rejected}"
        failure = certificate.failure({**evidence, **measured}, pair.claim)
        if failure is not None:
            return f"{certificate.name}: {failure}"
        evidence |= certificate.kept(measured)
    return record.model_copy(update={"evidence": evidence})
