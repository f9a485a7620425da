"""What each partition of each stage was made from, and whether that is still what is there.

The truth lies in the tables' footers (`storage.parquet.State`): the versions of the inputs at the time of writing. A
partition is stale when an input's version is another now. Dagster is told the same versions, so its UI agrees; this
module also answers where Dagster does not (unpartitioned assets, more than 100 upstream partitions, lost clips).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Literal

from traps_pipeline.benchmark.corrections import folded, load_scenarios
from traps_pipeline.benchmark.items import categories_of_dataset
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.benchmark.specs import released_in_study
from traps_pipeline.benchmark.videos import missing_clips
from traps_pipeline.digests import digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.judging.panel import SCHEMAS, load_judges, load_panel
from traps_pipeline.models.media import profile_digest
from traps_pipeline.models.prompts import prompt, system_prompt
from traps_pipeline.models.registry import all_evaluations, effective_params, get_model, load_accounts, load_models
from traps_pipeline.partitions import CATEGORIES, DATASETS, Cell, Evaluation
from traps_pipeline.storage.parquet import State
from traps_pipeline.storage.workspace import Workspace, write_text
from traps_pipeline.tables import TABLES

REPORTS = ("pecs_landscape", "contact_sheet", "gallery", "shortcuts", "leaderboard_page")
STAGES = ("scene_specs", "videos", "items", "responses", "votes", "verdicts", "metrics", "leaderboard", *REPORTS)
SOURCES = ("released_specs", "corrections", "models", "prompts", "judges")
PARTITIONED_BY: Mapping[str, Literal["category", "dataset", "cell", "evaluation"]] = {
    "released_specs": "category",
    "corrections": "category",
    "scene_specs": "category",
    "videos": "category",
    "items": "dataset",
    "models": "evaluation",
    "prompts": "evaluation",
    "responses": "cell",
    "votes": "cell",
    "verdicts": "cell",
    "metrics": "dataset",
}
Node = tuple[str, str | None]  # stage or source, and its partition key


@dataclass(frozen=True)
class Status:
    """fresh, stale (with what changed, and how many calls failed) or missing."""

    kind: Literal["fresh", "stale", "missing"]
    outdated: tuple[str, ...] = ()
    failed: int = 0

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is stale, in words."""
        return (*self.outdated, f"{self.failed} calls failed and can be asked again") if self.failed else self.outdated


def name_of(node: Node) -> str:
    """`stage` or `stage/key`, as footers store it."""
    return node[0] if node[1] is None else f"{node[0]}/{node[1]}"


def upstream(stage: str, key: str | None) -> list[Node]:
    """Every partition that a partition may be made from, whether it is there or not."""
    match stage:
        case "scene_specs":
            return [("released_specs", key), ("corrections", key)]
        case "videos":
            return [("scene_specs", key)]
        case "items":
            return [(s, c) for c in categories_of_dataset(str(key)) for s in ("scene_specs", "videos")]
        case "responses":
            cell = Cell.parse(str(key))
            return [("items", cell.dataset), ("models", cell.evaluation.key), ("prompts", cell.evaluation.key)]
        case "votes":
            return [("items", Cell.parse(str(key)).dataset), ("responses", key), ("judges", None)]
        case "verdicts":
            return [("items", Cell.parse(str(key)).dataset), ("responses", key), ("votes", key)]
        case "metrics":
            return [("items", key), *(("verdicts", Cell(str(key), e).key) for e in all_evaluations())]
        case "leaderboard":
            verdicts = [("verdicts", Cell(d, e).key) for d in DATASETS for e in all_evaluations()]
            return [*(("metrics", d) for d in DATASETS), *verdicts]
        case "pecs_landscape":
            return [("leaderboard", None)]
        case "contact_sheet":
            return [("items", d) for d in DATASETS]
        case "gallery":
            return [(s, c) for c in CATEGORIES for s in ("scene_specs", "videos")]
        case "shortcuts":
            return [*(("items", d) for d in DATASETS), *(("videos", c) for c in CATEGORIES)]
        case "leaderboard_page":
            return [("leaderboard", None), *((s, None) for s in ("pecs_landscape", "contact_sheet", "shortcuts"))]
    raise KeyError(f"unknown stage {stage!r}; known: {', '.join(STAGES)}")


def partition_of(stage: str, key: str | None) -> dict[str, str | int]:
    """Values of a table's partition columns for a partition key."""
    kind = PARTITIONED_BY.get(stage)
    if kind is None:
        return {}
    return Cell.parse(str(key)).partition if kind == "cell" else {kind: str(key)}


def keys_of(name: str) -> list[str | None]:
    """All partition keys of a stage or source."""
    match PARTITIONED_BY.get(name):
        case "category":
            return list(CATEGORIES)
        case "dataset":
            return list(DATASETS)
        case "evaluation":
            return [e.key for e in all_evaluations()]
        case "cell":
            return [Cell(d, e).key for d in DATASETS for e in all_evaluations()]
    return [None]


class Lineage:
    """A view of a workspace at one moment; versions are looked up once."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self.version = cache(self._version)
        self.state = cache(self._state)
        self._released = cache(lambda category: released_in_study(workspace, category))

    def inputs(self, stage: str, key: str | None) -> dict[str, str]:
        """Versions of everything that is there to make a partition from, by name."""
        versions = {name_of(node): self.version(*node) for node in upstream(stage, key)}
        return {name: version for name, version in versions.items() if version is not None}

    def status(self, stage: str, key: str | None) -> Status:
        """Whether a partition is there and made from what is there now."""
        state = self.state(stage, key)
        if state is None:
            return Status("missing")
        reasons = [*_differences(state.inputs, self.inputs(stage, key))]
        if stage == "videos":
            reasons += [f"clip {path} is gone or damaged" for path in missing_clips(self._workspace, str(key))]
        return Status("stale", tuple(reasons), state.failed) if reasons or state.failed else Status("fresh")

    def _state(self, stage: str, key: str | None) -> State | None:
        if stage in TABLES:
            return self._workspace.tables.state(TABLES[stage], partition_of(stage, key))
        return read_report_state(self._workspace, stage)

    def _version(self, name: str, key: str | None) -> str | None:
        if name in SOURCES:
            return self._source_version(name, key)
        state = self.state(name, key)
        return state.version if state else None

    def _source_version(self, name: str, key: str | None) -> str:
        match name:
            case "released_specs":
                return digest([spec.spec_hash for spec in self._released(key).values()])[:16]
            case "corrections":
                scenarios = load_scenarios(self._workspace.study).values()
                return digest([[s.scenario_id, s.version] for s in scenarios if s.category == key])[:16]
            case "models":
                entry = get_model(Evaluation.parse(str(key)).model)
                sent = [effective_params(entry, Evaluation.parse(str(key)).regime)]
                sent += [profile_digest(entry.media)] if entry.media else []
                return digest([entry.id, entry.provider_id or entry.backend, *sent])[:16]
            case "prompts":
                return digest(system_prompt(Evaluation.parse(str(key)).regime))[:16]
            case "judges":
                panel = [
                    [judge.id, judge.provider_id or judge.backend, judge.params, SCHEMAS]
                    for judge in load_panel(self._workspace.study.panel)
                ]
                return digest([panel, prompt("judge_abstention"), prompt("judge_correctness")])[:16]
        raise KeyError(f"unknown source {name!r}; known: {', '.join(SOURCES)}")


def reread_sources() -> None:
    """Forget what was read of specs, corrections, prompts and registries: a server that lives long sees edits then.

    Which evaluations there are stays: partition keys are made from them when the code location is loaded.
    """
    for cached in (load_released, folded, load_models, load_accounts, prompt, system_prompt, load_judges, load_panel):
        cached.cache_clear()


def _differences(then: Mapping[str, str], now: Mapping[str, str]) -> Iterable[str]:
    for name in sorted(then.keys() | now.keys()):
        if name not in now:
            yield f"{name} is gone"
        elif name not in then:
            yield f"{name} is new"
        elif then[name] != now[name]:
            yield f"{name} changed"


def write_report_state(workspace: Workspace, name: str, version: str, inputs: Mapping[str, str]) -> None:
    """What a report (which is no table) was made from, beside it."""
    state = State(version, dict(inputs), rows=0, failed=0)
    write_text(workspace.reports / f"{name}.state.json", json.dumps(asdict(state)))


def read_report_state(workspace: Workspace, name: str) -> State | None:
    """The state that `write_report_state` wrote; None if the report was never made."""
    path = workspace.reports / f"{name}.state.json"
    if not path.is_file():
        return None
    try:
        return State(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise TrapsError(f"{path}: is not what was written ({error}); delete it and run again") from error
