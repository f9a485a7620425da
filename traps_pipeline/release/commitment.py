"""Commit to a benchmark before anybody sees it, and prove its identity later.

The commitment holds digests of the seed and of each record, all mixed with a secret number, so that nobody can search
for the seed. The reveal holds the seed and that number. Anyone with both can draw the benchmark again.
"""

from __future__ import annotations

import json
import platform
import secrets
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.terminal import plain
from traps_pipeline.base.workers import keep_workers
from traps_pipeline.base.yamlfile import faults_of, read_lines
from traps_pipeline.benchmark.held_out import require_secret_seed
from traps_pipeline.benchmark.records import (
    load_release,
    load_released,
    parse_record,
    parse_two_events,
    refuse_recorded,
    two_events_lines,
)
from traps_pipeline.scenes.draw.draw_lanes import difficulty_of, sample_two_events
from traps_pipeline.scenes.draw.sample import load_tallies, sample_family
from traps_pipeline.scenes.parts.difficulty import DEFAULT_DIFFICULTY, Difficulty
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.spec import SceneSpec, load_trajectory

_HEX = r"^[0-9a-f]{64}$"
# Fields of a record that depend on arithmetic: another CPU or simulator version may draw the same scene differently.
_OF_ARITHMETIC = dict.fromkeys(("evidence", "trajectory_sha256", "twin", "control"), True)
_OF_LANES: dict[str, Any] = {"camera": True, "lanes": {"__all__": {"lane", "layout", "twin"}}}
_LIBRARIES = ("mujoco", "numpy")
Specs = Mapping[str, SceneSpec | TwoEventsSpec]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Commitment(_Strict):
    """The public file that commits to held-out scenarios before they are released.

    draws, two_events: pairs, and scenarios of two events, by family. look: the varied parts of the look, by family.
    difficulty: settings of every scene. seed: digest of the seed. specs: digest of each record. made_with: machine and
    libraries, which may affect the arithmetic of a draw.
    """

    format: Literal[1] = 1
    name: str
    version: str
    canary: str
    draws: dict[str, int]
    two_events: dict[str, int] = {}
    look: dict[str, list[str]] = {}
    difficulty: Difficulty = DEFAULT_DIFFICULTY
    seed: str = Field(pattern=_HEX)
    specs: dict[str, str] = Field(min_length=1)
    made_with: dict[str, str]


class Reveal(_Strict):
    """The secret file, kept until the benchmark is revealed; `nonce` is hexadecimal."""

    format: Literal[1] = 1
    seed: int = Field(ge=0)
    nonce: str = Field(pattern=_HEX)


def _seal_seed(reveal: Reveal, draws: Mapping[str, int], two_events: Mapping[str, int]) -> str:
    return digest(["seed", reveal.nonce, reveal.seed, dict(draws), *([dict(two_events)] if two_events else [])])


def _seal_spec(reveal: Reveal, spec: SceneSpec | TwoEventsSpec) -> str:
    return digest(["spec", reveal.nonce, spec.scenario_id, spec.spec_hash])


def commit(benchmark: Path, commitment: Path, reveal: Path) -> Commitment:
    """Commit to a benchmark: write the public file, and the secret one for its owner.

    benchmark: folder that `traps benchmark sample` wrote. Raises TrapsError if the folder is no such benchmark, or of
    several seeds, and if either file exists.
    """
    for path in (commitment, reveal):
        if path.exists():
            raise TrapsError(f"{path}: is there already, and a commitment is made once; name another file")
    refuse_recorded("traps benchmark commit", benchmark / "released")
    specs, tallies = load_released(benchmark / "released"), load_tallies(benchmark / "released")
    lanes = _two_events(benchmark)
    drawn_lanes = {(lane.seed, difficulty_of(lane.model_dump(mode="json"))) for lane in lanes.values()}
    draws_of = {(tally.seed, tally.difficulty) for tally in tallies.values()}
    draws_of |= {(seed, replace(difficulty, window_s=DEFAULT_DIFFICULTY.window_s)) for seed, difficulty in drawn_lanes}
    if len(draws_of) != 1 or len(drawn_lanes) > 1 or {spec.family for spec in specs.values()} != {*tallies}:
        raise TrapsError(
            f"{benchmark}: is not one draw of one seed and difficulty; draw one with `traps benchmark sample` into a "
            "new folder"
        )
    require_secret_seed(benchmark)
    ((seed, difficulty),) = drawn_lanes or draws_of
    secret = Reveal(seed=seed, nonce=secrets.token_hex(32))
    release, draws = load_release(benchmark / "benchmark.yaml"), {n: t.wanted for n, t in sorted(tallies.items())}
    two_events = dict(sorted(Counter(lane.family for lane in lanes.values()).items()))
    published = Commitment(
        **release.model_dump(include={"name", "version", "canary"}),
        draws=draws,
        two_events=two_events,
        look={name: tally.look for name, tally in sorted(tallies.items())},
        difficulty=difficulty,
        seed=_seal_seed(secret, draws, two_events),
        specs={id_: _seal_spec(secret, spec) for id_, spec in sorted({**specs, **lanes}.items())},
        made_with=_arithmetic(),
    )
    write_text(reveal, secret.model_dump_json(indent=1) + "\n", private=True)
    write_text(commitment, published.model_dump_json(indent=1) + "\n")
    return published


def _two_events(benchmark: Path) -> dict[str, TwoEventsSpec]:
    return {id_: line.spec for id_, line in two_events_lines(benchmark / "two_events" / "released").items()}


def _arithmetic() -> dict[str, str]:
    return {"machine": platform.machine(), **{name: version(name) for name in _LIBRARIES}}


def read_commitment(path: Path) -> Commitment:
    """Read the public file that commits to held-out scenarios. Raises TrapsError."""
    return _read(Commitment, path)


def read_reveal(path: Path) -> Reveal:
    """Read the file that reveals held-out scenarios of a commitment. Raises TrapsError."""
    return _read(Reveal, path)


def _read(kind: type[Any], path: Path) -> Any:
    try:
        return kind.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise TrapsError(f"{path}: is no {kind.__name__.lower()} ({faults_of(error)}); get the file again") from error
    except OSError as error:
        raise TrapsError(
            f"{path}: cannot be read ({error.strerror}); name a file of `traps benchmark commit`"
        ) from error


# --- verification -----------------------------------------------------------------------------------------------------


def revealed_specs(folder: Path) -> Specs:
    """Return a folder's records. Raises TrapsError, also for an altered trajectory."""
    from traps_pipeline.benchmark.filmed_lanes import trajectories_of
    from traps_pipeline.benchmark.specs import spec_of

    if (folder / "scenarios.jsonl").is_file():
        path, revealed = folder / "scenarios.jsonl", dict[str, SceneSpec | TwoEventsSpec]()
        for number, line in read_lines(path):
            try:
                spec = spec_of(json.loads(line))
            except (ValueError, KeyError, TypeError) as error:
                raise TrapsError(f"{path}:{number}: is no record ({plain(error)[:200]}); get it again") from error
            revealed[spec.scenario_id] = parse_record(spec.model_dump_json(), f"{path}:{number}")
        path = folder / "two_events.jsonl"
        for number, line in read_lines(path) if path.is_file() else ():
            lane = parse_two_events(json.loads(line)["record"], f"{path}:{number}")
            revealed[lane.scenario_id] = lane
        return revealed
    specs = {**load_released(folder / "released"), **_two_events(folder)}
    for spec in specs.values():
        path = folder / "released" / "trajectories" / f"{spec.scenario_id}.npz"
        try:
            if isinstance(spec, TwoEventsSpec):
                trajectories_of(spec, folder / "two_events" / path.relative_to(folder))
                continue
            load_trajectory(path, spec.trajectory_sha256)
            load_trajectory(path, spec.twin.trajectory_sha256, "twin")
        except ValueError as error:
            raise TrapsError(str(error)) from error
    return specs


def broken_seals(commitment: Commitment, reveal: Reveal, specs: Specs) -> list[str]:
    """Return how records differ from the commitment, one sentence each, seed first."""
    problems = []
    if _seal_seed(reveal, commitment.draws, commitment.two_events) != commitment.seed:
        problems.append("the revealed seed, number or composition is not the one that was committed")
    for id_ in sorted({*commitment.specs, *specs}):
        if id_ not in specs:
            problems.append(f"{id_}: was committed and is not there")
        elif id_ not in commitment.specs:
            problems.append(f"{id_}: was not committed")
        elif _seal_spec(reveal, specs[id_]) != commitment.specs[id_]:
            problems.append(f"{id_}: is not the record that was committed")
    return problems


def redraw_records(
    commitment: Commitment,
    reveal: Reveal,
    *,
    workers: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Specs:
    """Redraw the revealed seed's records. Raises TrapsError for an unfillable family."""
    with TemporaryDirectory(prefix="traps-") as folder:
        of_pairs = replace(commitment.difficulty, window_s=DEFAULT_DIFFICULTY.window_s)
        with keep_workers():
            for family, count in commitment.two_events.items():
                report(f"drawing {count} of two events of {family} again")
                drawn = ([family], count, reveal.seed, Path(folder) / "two_events" / "released", commitment.difficulty)
                sample_two_events(*drawn, workers=workers, report=report)
            for family, count in commitment.draws.items():
                report(f"drawing {count} of {family} again")
                try:
                    sample_family(
                        family,
                        count,
                        reveal.seed,
                        Path(folder) / "released",
                        look=commitment.look.get(family, ()),
                        difficulty=of_pairs,
                        workers=workers,
                        report=report,
                    )
                except (RuntimeError, KeyError) as error:
                    raise TrapsError(
                        f"{family}: the seed does not give {count} scenarios here ({plain(error)})"
                    ) from error
        return {**load_released(Path(folder) / "released"), **_two_events(Path(folder))}


def is_same_scene(spec: SceneSpec | TwoEventsSpec, other: SceneSpec | TwoEventsSpec) -> bool:
    """Return whether records differ only in fields that depend on machine arithmetic."""
    excluded = _OF_ARITHMETIC | (_OF_LANES if isinstance(spec, TwoEventsSpec) else {})
    return spec.model_dump(exclude=excluded) == other.model_dump(exclude=excluded)


def environment_differences(commitment: Commitment) -> str:
    """Return how machine and libraries differ from the commitment's, if they do."""
    own_machine = _arithmetic()
    names = [name for name in own_machine if commitment.made_with.get(name) != own_machine[name]]
    return ", ".join(
        f"{name} {commitment.made_with.get(name, 'unknown')} there, {own_machine[name]} here" for name in names
    )
