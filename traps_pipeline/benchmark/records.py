"""Read the benchmark's name and its records, one resolved scenario per JSON line."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import from_json

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import Name
from traps_pipeline.base.paths import RELEASED, SCENE_SPECS
from traps_pipeline.base.yamlfile import check_line, explain, parse_yaml_model, read_unchecked_lines, read_yaml
from traps_pipeline.protocol.datasets import ALL_CATEGORIES
from traps_pipeline.scenes.family_registry import family_names
from traps_pipeline.scenes.worlds.spec import SceneSpec


class Release(BaseModel):
    """`scene_specs/benchmark.yaml`: the name, and a canary for contamination checks."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: Name
    version: str
    canary: str


@cache
def load_release(path: Path = SCENE_SPECS / "benchmark.yaml") -> Release:
    """Return name and version of the released benchmark."""
    return parse_yaml_model(Release, read_yaml(path), path)


@dataclass(frozen=True)
class ReleasedLine:
    """A line of a released record, checked and parsed when `spec` is asked for.

    A command of a small study asks for a few of hundreds, and parsing all takes longer than all else it does.
    """

    scenario_id: str
    family: str
    category: str
    line: str
    where: str

    @cached_property
    def spec(self) -> SceneSpec:
        """The record. Raises TrapsError naming file, line and remedy."""
        check_line(self.line, self.where)
        return parse_record(self.line, self.where)


@cache
def load_released(folder: Path = RELEASED) -> dict[str, SceneSpec]:
    """Return released records by id. Raises TrapsError naming file, line and remedy."""
    return {id_: line.spec for id_, line in released_lines(folder).items()}


@cache
def released_lines(folder: Path = RELEASED) -> dict[str, ReleasedLine]:
    """Return lines of released records by id. Raises TrapsError with file and remedy."""
    records: dict[str, ReleasedLine] = {}
    for path in sorted(folder.glob("*.jsonl")):
        for number, line in read_unchecked_lines(path):
            record_line = _line(line, f"{path}:{number}")
            if record_line.scenario_id in records:
                raise TrapsError(
                    f"{path}:{number}: scenario {record_line.scenario_id!r} occurs twice; remove one of the lines"
                )
            records[record_line.scenario_id] = record_line
    if not records:
        raise TrapsError(
            f"{folder}: holds no released records; restore it from git or draw some with `traps benchmark sample`"
        )
    return records


def _line(line: str, where: str) -> ReleasedLine:
    """Return a line that names scenario, family and category, or raise TrapsError."""
    try:
        fields: Any = from_json(line)
        scenario_id, family, category = (str(fields[name]) for name in ("scenario_id", "family", "category"))
    except (ValueError, KeyError, TypeError):
        check_line(line, where)
        spec = parse_record(line, where)
        scenario_id, family, category = spec.scenario_id, spec.family, spec.category
    return ReleasedLine(scenario_id, family, category, line, where)


def parse_record(line: str, where: str) -> SceneSpec:
    """Parse a released file's line. Raises TrapsError."""
    try:
        spec = SceneSpec.model_validate(from_json(line))  # twice as fast as `json`, with the same numbers
    except ValidationError as error:
        raise TrapsError(f"{where}: not a valid record ({explain(error)}); restore the line from git") from error
    except ValueError as error:
        raise TrapsError(f"{where}: not JSON ({error}); restore the line from git") from error
    if spec.family not in family_names():
        known = f"known: {', '.join(family_names())}"
        advice = f"install {spec.evidence['package']}, which adds it" if "package" in spec.evidence else known
        raise TrapsError(f"{where}: {spec.scenario_id}: unknown family {spec.family!r}; {advice}")
    if spec.category not in ALL_CATEGORIES:
        raise TrapsError(
            f"{where}: {spec.scenario_id}: unknown category {spec.category!r}; known: {', '.join(ALL_CATEGORIES)}"
        )
    return spec
