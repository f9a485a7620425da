"""Who a judge is: `assets/judges.yaml`, its panels, and what a judge is told to return. What a panel does with its
votes stands in `judging/`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal

from traps_pipeline.digests import digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.models.prompts import prompt
from traps_pipeline.models.registry import JUDGE_PROTOCOL, Entry, Limits, Protocol, read_entries, structured
from traps_pipeline.paths import ASSETS
from traps_pipeline.yamlfile import read_mapping

JUDGES_FILE = ASSETS / "judges.yaml"
PANEL_SIZE = 3
Task = Literal["abstention", "correctness"]


# What a judge over the network is told to return; what it does return is checked by `judging.panel` all the same.
SCHEMAS: Mapping[Task, Mapping[str, Any]] = {
    "abstention": structured(
        "abstention",
        abstained={"type": "boolean"},
        confidence={"type": "string", "enum": ["high", "medium", "low"]},
        reasoning={"type": "string"},
    ),
    "correctness": structured(
        "correctness",
        correct={"type": "boolean"},
        extracted_value={"anyOf": [{"type": "string"}, {"type": "number"}, {"type": "null"}]},
        reasoning={"type": "string"},
    ),
}


class JudgeEntry(Entry):
    """One judge of `assets/judges.yaml`."""

    backend: Literal["rule", "api"]  # pyright: ignore[reportIncompatibleVariableOverride] - fields are frozen
    limits: Limits = Limits(concurrency=12)

    def protocol(self) -> Protocol:
        """See `Entry.protocol`."""
        return JUDGE_PROTOCOL


@cache
def load_judges(path: Path = JUDGES_FILE) -> dict[str, JudgeEntry]:
    """Judges by id. Raises TrapsError naming judge and field."""
    return read_entries(path, "judges", JudgeEntry)


@cache
def load_panel(name: str, path: Path = JUDGES_FILE) -> tuple[JudgeEntry, ...]:
    """The three judges of a panel. Raises TrapsError naming the file and what is wrong."""
    panels, judges = read_mapping(path).get("panels"), load_judges(path)
    if not isinstance(panels, dict) or name not in panels:
        raise TrapsError(f"{path}: no panel {name!r}; it has {', '.join(panels or ())}")
    seats = panels[name]
    whole = isinstance(seats, list) and len(seats) == len(set(seats)) == PANEL_SIZE
    if not whole or any(seat not in judges for seat in seats):
        raise TrapsError(f"{path}: panel {name!r} must seat {PANEL_SIZE} different known judges, not {seats}")
    return tuple(judges[seat] for seat in seats)


def panel_version(panel: str) -> str:
    """Version of what decides a panel's votes besides answers: judges, their prompts and schemas."""
    judges = [[judge.id, judge.endpoint, judge.params, SCHEMAS] for judge in load_panel(panel)]
    return digest([judges, prompt("judge_abstention"), prompt("judge_correctness")])[:16]
