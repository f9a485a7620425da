"""Giving released records what new draws of their family have: another floor, a control that a panel closes, a clip
that ends earlier, or a panel that covers no more than it must.

None moves anything, and a look may move neither camera nor panel. So a record with it is the one that `sample_family`
would have drawn: the trajectory stays, or its beginning does, and what pixels say is measured again. Whoever uses it
then runs `traps certify`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from traps_pipeline.errors import TrapsError
from traps_pipeline.files import write_text
from traps_pipeline.scenes.certificates import certificates_for, pair_of, stored_evidence
from traps_pipeline.scenes.closing import closed, record_of
from traps_pipeline.scenes.evidence import Pair, required
from traps_pipeline.scenes.kit import Physics, params_to_dict
from traps_pipeline.scenes.look import Look, look_of_draw
from traps_pipeline.scenes.outcome import Rejected
from traps_pipeline.scenes.pace import lengths, with_length
from traps_pipeline.scenes.registry import family_digest, get_family
from traps_pipeline.scenes.resolve import plain
from traps_pipeline.scenes.sample import load_tallies, record_line, save_tallies
from traps_pipeline.scenes.spec import SceneSpec, load_trajectory, save_trajectory, trajectory_digest
from traps_pipeline.scenes.trim import trimmed
from traps_pipeline.scenes.workers import run_in_order

STILL = ("floor", "light", "bystanders")  # parts of a look that move neither camera nor panel


def relook_family(
    released: Path, name: str, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> None:
    """Give all records of a family, whose looks are in STILL, the look of their draw, and measure again what pixels
    say. Raises TrapsError naming a record that is no longer certified; nothing is written then."""
    family, tallies = get_family(name), load_tallies(released)
    assert set(family.looks) <= set(STILL), f"{name}: looks in {', '.join(family.looks)}, of which some move the camera"
    _rewrite(released, name, _relooked, workers, report)
    tallies[name] = replace(tallies[name], file=family_digest(name), look=sorted(family.looks))
    save_tallies(released, tallies)


def close_family(
    released: Path, name: str, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> None:
    """Let the controls of all records of a family end as those of new draws do (`closing`), and measure again what is
    seen of them. Raises TrapsError naming a record that is no longer certified; nothing is written then."""
    _rewrite(released, name, _ended, workers, report)
    tallies = load_tallies(released)
    tallies[name] = replace(tallies[name], file=family_digest(name) if tallies[name].file else "")
    save_tallies(released, tallies)


def pace_family(
    released: Path, name: str, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> None:
    """Let the clips of all records of a family whose outcome settles too early end earlier (`pace`), and measure
    everything again. Raises TrapsError naming a record that is no longer certified; nothing is written then."""
    folder = released / "trajectories"
    for before, after in _rewrite(released, name, _shortened, workers, report):
        if before.trajectory_sha256 != after.trajectory_sha256:
            path, end = folder / f"{before.scenario_id}.npz", Physics(**after.physics).n_frames
            qpos = load_trajectory(path, before.trajectory_sha256)
            twin = load_trajectory(path, before.twin.trajectory_sha256, "twin")
            save_trajectory(folder, before.scenario_id, qpos[:end], twin[:end])


def trim_family(
    released: Path, name: str, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> None:
    """Cut the panels of all records of an occlusion family to what their twins need (`trim`), and measure everything
    again. Raises TrapsError naming a record that is certified with none; nothing is written then."""
    _rewrite(released, name, _cut, workers, report)


_Job = tuple[SceneSpec, Path, int]


def _rewrite(
    released: Path,
    name: str,
    change: Callable[[_Job], SceneSpec | str],
    workers: int | None,
    report: Callable[[str], None],
) -> list[tuple[SceneSpec, SceneSpec]]:
    """Change all records of a family, or none: change(record, folder of trajectories, seed) says why it cannot. Returns
    each record before and after."""
    seed, lines = load_tallies(released)[name].seed, released / f"{name}.jsonl"
    specs = [SceneSpec.model_validate_json(line) for line in lines.read_text(encoding="utf-8").splitlines()]
    jobs = [(spec, released / "trajectories", seed) for spec in specs]
    found: list[SceneSpec] = []
    for job, seen in run_in_order(change, jobs, workers):
        if isinstance(seen, str):
            raise TrapsError(f"{job[0].scenario_id}: {seen}; take it out (`take_out`) and draw it anew")
        found.append(seen)
        report(f"{seen.scenario_id}: {len(found)} of {len(specs)}")
    write_text(lines, "".join(record_line(spec) for spec in found))
    return list(zip(specs, found, strict=True))


def _ended(job: _Job) -> SceneSpec | str:
    """A record whose control ends as a new draw's does, or which certificate it loses."""
    spec, folder, _ = job
    path = folder / f"{spec.scenario_id}.npz"
    qpos = load_trajectory(path, spec.trajectory_sha256)
    twin = load_trajectory(path, spec.twin.trajectory_sha256, "twin")
    plainly = spec.model_copy(update={"control": None})
    try:
        pair, evidence = closed(pair_of(plainly, qpos, twin), spec.seed, stored_evidence(plainly))
    except Rejected as rejected:
        return str(rejected)
    kept = {name: value for each in certificates_for(spec.void_kind) for name, value in each.kept(evidence).items()}
    return spec.model_copy(update={"control": plain(record_of(pair)), "evidence": plain(kept)})


def _shortened(job: _Job) -> SceneSpec | str:
    """A record whose clips end as a new draw's do, or which certificate it loses."""
    spec, folder, _ = job
    path = folder / f"{spec.scenario_id}.npz"
    qpos = load_trajectory(path, spec.trajectory_sha256)
    twin = load_trajectory(path, spec.twin.trajectory_sha256, "twin")
    whole = spec.model_copy(update={"control": None})
    found = "there is no length"
    for n_frames in lengths(pair_of(whole, qpos, twin).control, spec.seed):
        if n_frames == len(qpos):
            return spec
        control, other = qpos[:n_frames], twin[:n_frames]
        physics = plain(asdict(with_length(Physics(**spec.physics), n_frames)))
        ends = {"physics": physics, "trajectory_sha256": trajectory_digest(control)}
        ends["twin"] = spec.twin.model_copy(update={"trajectory_sha256": trajectory_digest(other)})
        shorter = whole.model_copy(update=ends)
        try:
            return _measured(shorter, pair_of(shorter, control, other))
        except Rejected as rejected:
            found = str(rejected)
    return found


def _cut(job: _Job) -> SceneSpec | str:
    """A record whose panel covers what a new draw's does, or which certificate it loses."""
    spec, folder, _ = job
    path = folder / f"{spec.scenario_id}.npz"
    qpos = load_trajectory(path, spec.trajectory_sha256)
    twin = load_trajectory(path, spec.twin.trajectory_sha256, "twin")
    found = "there is no panel"
    for pair in trimmed(pair_of(spec.model_copy(update={"control": None}), qpos, twin)):
        assert pair.control.panel is not None, "only a panel can be trimmed"
        void = {"panel": asdict(pair.control.panel), "hidden_from_frame": pair.void_from}
        try:
            return _measured(spec.model_copy(update={"void": plain(void)}), pair)
        except Rejected as rejected:
            found = str(rejected)
    return found


def _measured(spec: SceneSpec, pair: Pair) -> SceneSpec:
    """A record with all its evidence and how its control closes, from its pair as it is before. Raises Rejected."""
    certificates = certificates_for(spec.void_kind)
    measured = required([c for c in certificates if c.name != "closing"], pair, {})
    closing, evidence = closed(pair, spec.seed, measured)
    kept = {name: value for each in certificates for name, value in each.kept(evidence).items()}
    return spec.model_copy(update={"control": plain(record_of(closing)), "evidence": plain(kept)})


def _relooked(job: _Job) -> SceneSpec | str:
    """A record with the look of its draw, or which certificate it loses under it."""
    spec, folder, seed = job
    family, path = get_family(spec.family), folder / f"{spec.scenario_id}.npz"
    look = look_of_draw(seed, spec.family, spec.seed, sorted(family.looks))
    qpos = load_trajectory(path, spec.trajectory_sha256)
    return with_look(spec, look, qpos, load_trajectory(path, spec.twin.trajectory_sha256, "twin"))


def with_look(spec: SceneSpec, look: Look | None, qpos: np.ndarray, twin: np.ndarray) -> SceneSpec | str:
    """A record under a look that moves neither camera nor panel, or which of the certificates that another picture may
    change it loses. qpos, twin: its trajectories, (F, nq) each."""
    family = get_family(spec.family)
    dressed = plain(params_to_dict(replace(family.params_from(spec.params), look=look)))
    other = spec.twin.params
    if other is not None:
        other = plain(params_to_dict(replace(family.params_from(other), look=look)))
    seen = spec.model_copy(update={"params": dressed, "twin": spec.twin.model_copy(update={"params": other})})
    pair, evidence = pair_of(seen, qpos, twin), dict(spec.evidence)
    for certificate in certificates_for(spec.void_kind):
        if not any(number.kept and not number.compared for number in certificate.numbers):
            continue
        try:
            measured = certificate.measured(pair)
        except Rejected as rejected:
            return f"{certificate.name}: {rejected}"
        failure = certificate.failure({**evidence, **measured}, pair.claim)
        if failure is not None:
            return f"{certificate.name}: {failure}"
        evidence |= certificate.kept(measured)
    return seen.model_copy(update={"evidence": evidence})
