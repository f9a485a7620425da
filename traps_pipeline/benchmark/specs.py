"""Resolve corrected scenarios to complete records with trajectories."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.paths import CORRECTIONS, PACKAGE, RELEASED, ROOT, user_cache
from traps_pipeline.benchmark.corrections import WORDS, Scenario, apply_words, load_scenarios, load_two_events, of_study
from traps_pipeline.benchmark.recorded_clips import clip_path
from traps_pipeline.benchmark.records import parse_record, released_lines, two_events_lines
from traps_pipeline.benchmark.versions import version_of
from traps_pipeline.scenes.family_registry import added_digests, get_family
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory, physics_record, save_trajectory
from traps_pipeline.storage.benchmark_tables import SCENE_SPECS, SceneSpecRow
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from traps_pipeline.scenes.draw.resolve import Resolved
    from traps_pipeline.scenes.physics.kit import Wording

SECONDS_A_RECORD = 0.04  # measured on one core: read a scenario's trajectories, and recompute its evidence


@dataclass(frozen=True)
class ResolvedScenario:
    """A record and the path of its trajectory."""

    spec: SceneSpec
    trajectory: Path


def resolve_scenario(workspace: Workspace, scenario: Scenario) -> ResolvedScenario:
    """Return the corrected record and its trajectory; a changed or added scene is simulated once."""
    if scenario.params is None:
        spec = scenario.changed_words()
        if spec.is_recorded:
            return ResolvedScenario(spec, clip_path(RELEASED, spec.scenario_id, "control"))
        return ResolvedScenario(spec, RELEASED / "trajectories" / f"{spec.scenario_id}.npz")
    spec, trajectory = _resolve_again(workspace, scenario)
    words = dict(scenario.words)
    if _has_valid_words(scenario):
        assert scenario.released is not None
        words = scenario.released.model_dump(mode="json", include=set(WORDS)) | words
    answer = words.pop("answer", spec.ground_truth)
    if answer != spec.ground_truth:
        raise TrapsError(
            f"{scenario.where}: {scenario.scenario_id}: the correction says {answer!r}, "
            f"the simulation {spec.ground_truth!r}; leave the answer out or change the parameters"
        )
    return ResolvedScenario(apply_words(spec, words, scenario.where), trajectory)


def _resolve_again(workspace: Workspace, scenario: Scenario) -> tuple[SceneSpec, Path]:
    """Return the scene of corrected parameters, with its family's words; stored once."""
    name = _resolution_name(scenario)
    files = [workspace.trajectories / f"{name}{ending}" for ending in (".npz", ".json")]
    workspace.store.bring(files)
    for folder in (CORRECTIONS / "trajectories", workspace.trajectories):
        if (folder / f"{name}.json").is_file():
            record = (folder / f"{name}.json").read_text(encoding="utf-8")
            return parse_record(record, str(folder / f"{name}.json")), folder / f"{name}.npz"
    resolution = _simulate(scenario)
    try:
        save_trajectory(workspace.trajectories, name, resolution.worlds)
    except OSError as error:
        raise TrapsError(f"{workspace.trajectories / name}.npz: cannot be written ({error.strerror})") from error
    record = json.dumps(resolution.spec.model_dump(mode="json"))
    write_text(workspace.trajectories / f"{name}.json", record)  # last, so that it vouches for the trajectory
    workspace.store.keep(files)
    progress.current().note(
        f"{scenario.scenario_id}: simulated here after {scenario.where}; to freeze it for other machines copy "
        f"trajectories/{name}.* of the workspace to {CORRECTIONS / 'trajectories'}"
    )
    return resolution.spec, workspace.trajectories / f"{name}.npz"


def _resolution_name(scenario: Scenario) -> str:
    scene = [scenario.family, scenario.params, _seed(scenario), _physics(scenario)]
    return f"{scenario.scenario_id}-{digest(scene)[:16]}"


def _seed(scenario: Scenario) -> int:
    return scenario.released.seed if scenario.released else 0


def _physics(scenario: Scenario) -> dict[str, Any]:
    return scenario.released.physics if scenario.released else physics_record(get_family(scenario.family).physics)


def _wording(scenario: Scenario, params: Mapping[str, Any]) -> Wording:
    return wording_of(scenario.family, _seed(scenario), scenario.scenario_id, params)


def wording_of(family_name: str, seed: int, scenario_id: str, params: Mapping[str, Any]) -> Wording:
    """Return the question and labels of a scenario, drawn by its seed and id.

    Raises ValueError or TypeError if the family has no such parameters.
    """
    family = get_family(family_name)
    rng = np.random.default_rng([seed, *scenario_id.encode()])
    return family.word(family.params_from(params), rng)


def _has_valid_words(scenario: Scenario) -> bool:
    """Return whether released and corrected parameters have the same family words."""
    record = scenario.released
    return record is not None and _wording(scenario, record.params) == _wording(scenario, scenario.params or {})


def _simulate(scenario: Scenario) -> Resolved:
    """Simulate a corrected scene. Raises TrapsError naming the correction."""
    from traps_pipeline.scenes.draw.resolve import resolve
    from traps_pipeline.scenes.parts.wording import draw_ill_posed
    from traps_pipeline.scenes.physics.kit import Physics
    from traps_pipeline.scenes.worlds.outcome import Rejected

    family = get_family(scenario.family)
    try:
        params = family.params_from(scenario.params or {})
        wording = _wording(scenario, scenario.params or {})
        physics = Physics(**_physics(scenario))
        rng = np.random.default_rng([_seed(scenario), *scenario.scenario_id.encode(), 1])
        question = draw_ill_posed(family.taxonomy, family.build(params, physics).inventory, rng)
        return resolve(
            family, params, wording, question, scenario_id=scenario.scenario_id, seed=_seed(scenario), physics=physics
        )
    except (Rejected, ValueError, TypeError) as error:
        raise TrapsError(
            f"{scenario.where}: {scenario.scenario_id}: these parameters make no valid pair ({error}); "
            "change them or discard it"
        ) from error


def seconds_left(workspace: Workspace, category: str) -> float:
    """Estimate one core's time to build a category's table."""
    return SECONDS_A_RECORD * sum(
        scenario.category == category for scenario in load_scenarios(workspace.study).values()
    )


def build_specs(workspace: Workspace, category: str) -> tuple[list[SceneSpecRow], list[ResolvedScenario]]:
    """Return a category's rows of SCENE_SPECS and resolved records, with trajectories verified."""
    scenarios = [s for s in load_scenarios(workspace.study).values() if s.category == category]
    resolved_scenarios = [resolve_scenario(workspace, scenario) for scenario in scenarios]
    released_specs = released_in_study(workspace, category).values()
    version = version_of((spec.spec_hash for spec in released_specs), (r.spec.spec_hash for r in resolved_scenarios))
    for item in resolved_scenarios:
        if item.spec.is_recorded:
            continue  # its clips are checked where they are copied
        try:
            get_family(item.spec.family).params_from(item.spec.params)
            load_trajectory(item.trajectory, item.spec.trajectory_sha256)
        except ValueError as error:
            raise TrapsError(f"{item.spec.scenario_id}: {error}") from error
    return [_row(workspace, item, version) for item in resolved_scenarios], resolved_scenarios


def spec_rows(workspace: Workspace, category: str) -> list[dict[str, Any]]:
    """Return a category's stored rows of SCENE_SPECS."""
    return workspace.tables.read(SCENE_SPECS, {"category": category}).to_dict("records")


def clips_version(workspace: Workspace, category: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the version of a category's clips, from its rows of SCENE_SPECS."""
    released_specs = released_in_study(workspace, category).items()
    return version_of(
        ([id_, spec.scene_hash] for id_, spec in released_specs),
        ([row["scenario_id"], row["scene_hash"]] for row in rows),
    )


def expected_specs(workspace: Workspace, category: str) -> list[SceneSpecRow]:
    """Return the rows of SCENE_SPECS that a run would build for a category now.

    Nothing is simulated or written: a scenario whose parameters were never simulated is left out. Raises TrapsError.
    """

    def is_resolved(scenario: Scenario) -> bool:
        name = f"{_resolution_name(scenario)}.json" if scenario.params is not None else ""
        is_stored = workspace.store.has(workspace.trajectories / name)
        return not name or is_stored or (CORRECTIONS / "trajectories" / name).is_file()

    scenarios = [s for s in load_scenarios(workspace.study).values() if s.category == category and is_resolved(s)]
    return [_row(workspace, resolve_scenario(workspace, scenario), "") for scenario in scenarios]


def released_in_study(workspace: Workspace, category: str) -> dict[str, SceneSpec]:
    """Return by id a category's released records in the study, uncorrected."""
    records = of_study(released_lines(), workspace.study)
    return {id_: record.spec for id_, record in sorted(records.items()) if record.category == category}


def released_version(workspace: Workspace, category: str) -> str:
    """Return the version of a category's released records in a study."""
    lanes = of_study(two_events_lines(), workspace.study, two_events_lines()).values()
    pairs = [spec.spec_hash for spec in released_in_study(workspace, category).values()]
    return digest([*pairs, *(line.line for line in lanes if line.category == category)])[:16]


def corrections_version(workspace: Workspace, category: str) -> str:
    """Return a category's version in a study, after the review decisions."""
    scenarios = load_scenarios(workspace.study).values()
    lanes = load_two_events(workspace.study).items()
    versions = [[s.scenario_id, s.version] for s in scenarios if s.category == category]
    return digest([*versions, *([id_, lane.version] for id_, lane in lanes if lane.category == category)])[:16]


def void_from_s(spec: SceneSpec) -> float:
    """Return the time (s) from which the void's occluder or its cut hides the outcome."""
    frame = spec.void["hidden_from_frame"] if spec.void_kind == "occluder" else spec.void["cut_frame"]
    return frame / spec.physics["fps"]


_AS_JSON = ("params", "physics", "camera", "void", "control", "aliases", "answerable_question", "twin")


def _row(workspace: Workspace, item: ResolvedScenario, version: str) -> SceneSpecRow:
    spec = item.spec
    record = spec.model_dump(mode="json", exclude={"evidence"})
    for name in _AS_JSON:
        record[name] = json.dumps(record[name], sort_keys=True, ensure_ascii=False)
    return SceneSpecRow(
        **record,
        scene_hash=spec.scene_hash,
        spec_hash=spec.spec_hash,
        trajectory=_relative(item.trajectory, workspace.root, ROOT),
        commit_s=float(spec.physics["duration_s"] if spec.is_recorded else spec.evidence["commit_s"]),
        margin_m=float(0.0 if spec.is_recorded else spec.evidence["margin_m"]),
        void_from_s=void_from_s(spec),
        evidence=json.dumps(spec.evidence, sort_keys=True),
        benchmark_version=version,
    )


def _relative(path: Path, *roots: Path) -> str:
    """Return the path relative to the first root above it, else unchanged."""
    root = next((root for root in roots if path.is_relative_to(root)), None)
    return (path.relative_to(root) if root else path).as_posix()


def spec_of(row: Mapping[str, Any]) -> SceneSpec:
    """Return the record that a row of SCENE_SPECS holds."""
    record = {name: row[name] for name in SceneSpec.model_fields}
    for name in (*_AS_JSON, "evidence"):
        record[name] = json.loads(record[name])
    record["labels"] = list(record["labels"])
    return SceneSpec.model_validate(record)


def trajectory_of(workspace: Workspace, row: Mapping[str, Any], world: str = "qpos") -> np.ndarray:
    """Return the frozen qpos (F, nq) of a row's scene or twin. Raises TrapsError."""
    candidates: Sequence[Path] = (ROOT / row["trajectory"], workspace.resolve(row["trajectory"]))
    path = next((p for p in candidates if p.is_file()), candidates[0])
    try:
        sha256 = row["trajectory_sha256"] if world == "qpos" else json.loads(row["twin"])["trajectory_sha256"]
        return load_trajectory(path, sha256, world)
    except ValueError as error:
        raise TrapsError(str(error)) from error


def unsettled_outcomes(resolved: Sequence[ResolvedScenario]) -> list[str]:
    """Return in words which outcomes differ when recomputed from the frozen trajectories.

    A file in the user's cache folder names the records that were found settled here by the same code, so that a
    corrected question replays no scene: importing and compiling MuJoCo's models takes half a second.
    """
    problems, known, settled = [], _settled_records(), set[str]()
    for item in resolved:
        spec, key = item.spec, _replayed(item.spec)
        if spec.is_recorded or spec.evidence.get("answer_from") == "correction" or key in known:
            continue  # nothing was simulated, or the reviewer's answer overrides the simulator's
        from traps_pipeline.scenes.certification.certificates import OUTCOME, pair_of

        qpos = load_trajectory(item.trajectory, spec.trajectory_sha256)
        pair = pair_of(spec, qpos, qpos[:0])
        evidence = OUTCOME.measured(pair)
        # Nothing is simulated here, so this machine's arithmetic may differ from the record's.
        failure = OUTCOME.failure(evidence, pair.claim) or OUTCOME.contradiction(evidence, spec.evidence, exact=False)
        if failure is not None:
            problems.append(f"{spec.scenario_id}: {failure}")
        else:
            settled.add(key)
    if settled:
        with suppress(OSError, RuntimeError):  # RuntimeError: a user without a home folder
            write_text(_settled_path(), json.dumps({_replaying_code(): sorted(known | settled)}))
    return problems


def _replayed(spec: SceneSpec) -> str:
    """Return the digest of all that decides a replayed outcome and its evidence."""
    return digest(spec.model_dump(mode="json", exclude={"question", "ill_posed_question", "answerable_question"}))


@cache
def _replaying_code() -> str:
    files = sorted((PACKAGE / "scenes").rglob("*.py"))
    return digest([metadata.version("mujoco"), *map(file_digest, files), *added_digests()])


def _settled_path() -> Path:
    return user_cache() / "settled.json"


def _settled_records() -> set[str]:
    with suppress(OSError, RuntimeError, ValueError, AttributeError):  # a damaged file counts as none
        return {*json.loads(_settled_path().read_text(encoding="utf-8")).get(_replaying_code(), [])}
    return set()
