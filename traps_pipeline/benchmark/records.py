"""Read the benchmark's name and its records, one resolved scenario per JSON line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import from_json

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import Name
from traps_pipeline.base.paths import OWN_SPECS, RELEASED, SCENE_SPECS, SPECS_VARIABLE, TWO_EVENTS_RELEASED
from traps_pipeline.base.yamlfile import check_line, faults_of, parse_yaml_model, read_unchecked_lines, read_yaml
from traps_pipeline.protocol.datasets import ALL_CATEGORIES, RECORDED
from traps_pipeline.scenes.family_registry import family_names
from traps_pipeline.scenes.worlds.spec import SceneSpec

if TYPE_CHECKING:  # importing it takes longer than reading the lines
    from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec

Record = TypeVar("Record", SceneSpec, "TwoEventsSpec")
NOT_MIXED = "holds simulated records, and recorded ones are never averaged with them; give each a folder of its own"


class Release(BaseModel):
    """The contents of `scene_specs/benchmark.yaml`: the name, and a canary for contamination checks."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: Name
    version: str
    canary: str


@cache
def load_release(path: Path = SCENE_SPECS / "benchmark.yaml") -> Release:
    """Return name and version of the released benchmark. Raises TrapsError for another version of the package's own."""
    release, own = (parse_yaml_model(Release, read_yaml(file), file) for file in (path, OWN_SPECS / "benchmark.yaml"))
    if release.name == own.name and release.version != own.version:
        raise TrapsError(
            f"{path}: these are records of {release.name} {release.version}, and this is the package of {own.version}, "
            f"which draws them otherwise: install the package of {release.version}, or unset {SPECS_VARIABLE}"
        )
    return release


@dataclass(frozen=True)
class ReleasedLine(Generic[Record]):
    """A line of a file of released records, parsed and checked when `spec` is read.

    A command of a small study asks for a few of hundreds, and parsing all takes longer than all else it does.
    """

    scenario_id: str
    family: str
    category: str
    line: str
    where: str
    parse: Callable[[str, str], Record]

    @cached_property
    def spec(self) -> Record:
        """The record. Raises TrapsError naming file, line and remedy."""
        check_line(self.line, self.where)
        return self.parse(self.line, self.where)


@cache
def load_released(folder: Path = RELEASED) -> dict[str, SceneSpec]:
    """Return released records by id. Raises TrapsError naming file, line and remedy."""
    return {id_: line.spec for id_, line in released_lines(folder).items()}


@cache
def released_lines(folder: Path = RELEASED) -> dict[str, ReleasedLine[SceneSpec]]:
    """Return lines of the released records by id; none beside two events alone. Raises TrapsError with remedy."""
    records = _lines(folder, parse_record)
    if records or two_events_lines(folder.parent / "two_events" / folder.name):
        return records
    raise TrapsError(
        f"{folder}: holds no released records; restore it from git or draw some with `traps benchmark sample`"
    )


@cache
def two_events_lines(folder: Path = TWO_EVENTS_RELEASED) -> dict[str, ReleasedLine[TwoEventsSpec]]:
    """Return by id the lines of the released records of two events; none in a benchmark without them."""
    return _lines(folder, parse_two_events)


def _lines(folder: Path, parse: Callable[[str, str], Record]) -> dict[str, ReleasedLine[Record]]:
    records: dict[str, ReleasedLine[Record]] = {}
    for path in sorted(folder.glob("*.jsonl")):
        for number, line in read_unchecked_lines(path):
            record_line = _line(line, f"{path}:{number}", parse)
            if record_line.scenario_id in records:
                raise TrapsError(
                    f"{path}:{number}: scenario {record_line.scenario_id!r} occurs twice; remove one of the lines"
                )
            records[record_line.scenario_id] = record_line
            if (record_line.family == RECORDED) != (next(iter(records.values())).family == RECORDED):
                raise TrapsError(f"{path}:{number}: {folder} {NOT_MIXED}")
    return records


def is_recorded(folder: Path = RELEASED) -> bool:
    """Return whether a benchmark's pairs are recorded videos; no benchmark has both kinds."""
    return any(line.family == RECORDED for line in released_lines(folder).values())


def refuse_recorded(what: str, folder: Path = RELEASED) -> None:
    """Raise TrapsError for work that needs the physics of scenes, which recorded pairs do not have."""
    if is_recorded(folder):
        raise TrapsError(f"{what}: not for recorded pairs, which nobody simulated; leave it out (docs/recorded.md)")


def _line(line: str, where: str, parse: Callable[[str, str], Record]) -> ReleasedLine[Record]:
    """Return a line that names scenario, family and category, or raise TrapsError."""
    try:
        fields: Any = from_json(line)
        scenario_id, family, category = (str(fields[name]) for name in ("scenario_id", "family", "category"))
    except (ValueError, KeyError, TypeError):
        check_line(line, where)
        spec = parse(line, where)
        scenario_id, family, category = spec.scenario_id, spec.family, spec.category
    return ReleasedLine(scenario_id, family, category, line, where, parse)


def parse_record(line: str, where: str) -> SceneSpec:
    """Parse a released file's line. Raises TrapsError."""
    return _parse(lambda _: SceneSpec, line, where)


def parse_two_events(line: str, where: str) -> TwoEventsSpec:
    """Parse a line of records of two events. Raises TrapsError."""
    from traps_pipeline.scenes.worlds.lane_records import RecordedEvents, TwoEventsSpec

    kinds = {True: RecordedEvents, False: TwoEventsSpec}
    return _parse(lambda fields: kinds[isinstance(fields, dict) and fields.get("family") == RECORDED], line, where)


def _parse(kind: Callable[[Any], type[Record]], line: str, where: str) -> Record:
    try:
        fields = from_json(line)  # twice as fast as `json`, with the same numbers
        spec = kind(fields).model_validate(fields)
    except ValidationError as error:
        raise TrapsError(f"{where}: not a valid record ({faults_of(error)}); restore the line from git") from error
    except ValueError as error:
        raise TrapsError(f"{where}: not JSON ({error}); restore the line from git") from error
    if spec.family not in (*family_names(), RECORDED):
        known = f"known: {', '.join(family_names())}"
        advice = f"install {spec.evidence['package']}, which adds it" if "package" in spec.evidence else known
        raise TrapsError(f"{where}: {spec.scenario_id}: unknown family {spec.family!r}; {advice}")
    if spec.category not in ALL_CATEGORIES:
        raise TrapsError(
            f"{where}: {spec.scenario_id}: unknown category {spec.category!r}; known: {', '.join(ALL_CATEGORIES)}"
        )
    return spec
