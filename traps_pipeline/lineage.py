"""What each partition of each stage was made from, and whether that is still what is there.

The truth lies in the tables' footers (`storage.parquet.State`): the versions of the inputs at the time of writing. A
partition is stale when an input's version is another now. Dagster is told the same versions, so its UI agrees; this
module also answers where Dagster does not (unpartitioned assets, more than 100 upstream partitions, lost clips).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import groupby
from typing import Literal

from traps_pipeline.benchmark.corrections import folded, load_scenarios
from traps_pipeline.benchmark.items import categories_of_dataset
from traps_pipeline.benchmark.records import load_released
from traps_pipeline.benchmark.specs import released_in_study
from traps_pipeline.benchmark.videos import missing_clips
from traps_pipeline.digests import digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.judging.confabulation import load_protocol, protocol_digest
from traps_pipeline.judging.panel import SCHEMAS, load_judges, load_panel
from traps_pipeline.mechanism.versions import (
    directions_are_there,
    extraction_version,
    probing_version,
    states_are_there,
    steering_version,
)
from traps_pipeline.models.media import profile_digest
from traps_pipeline.models.prompts import prompt, system_prompt, vqa_prompt
from traps_pipeline.models.registry import (
    all_evaluations,
    all_extractions,
    all_steered,
    effective_params,
    get_model,
    load_accounts,
    load_models,
    local_models,
)
from traps_pipeline.partitions import (
    ANSWERABLE,
    CATEGORIES,
    DATASETS,
    OCCLUSION_CATEGORIES,
    PROBED_DATASETS,
    Cell,
    Evaluation,
    Extraction,
    StatesCell,
    SteeringCell,
)
from traps_pipeline.report.catalogue import OF_PAPER, OF_STUDY, PRINTED
from traps_pipeline.scoring.published import published_digest
from traps_pipeline.storage.parquet import State
from traps_pipeline.storage.workspace import Workspace, write_text
from traps_pipeline.tables import JUDGE_VALIDATION, TABLES

REPORTS = ("contact_sheet", "gallery", "shortcuts", *PRINTED, "report_page")
EVALUATED = (
    "scene_specs",
    "videos",
    "items",
    "responses",
    "votes",
    "verdicts",
    "metrics",
    "contrasts",
    "regime_tests",
    "leaderboard",
)
JUDGED = ("agreement", "judge_bias", "leave_one_out", "confabulation", "confabulation_prevalence")
PROBED = ("probe_items", "hidden_states", "probes", "directions", "cosines")
STEERED = ("steering", "steering_votes", "steering_effects", "steering_shares")
INSIDE = (*PROBED, *STEERED)  # of experiments that look into models; others leave them out
STAGES = (*EVALUATED, *JUDGED, *INSIDE, *REPORTS)
SOURCES = ("released_specs", "corrections", "models", "prompts", "judges", "published")
SOURCES += ("confabulation_protocol", "judge_validation")
SOURCES += ("extraction_settings", "probing_settings", "steering_settings")
Kind = Literal["category", "dataset", "cell", "evaluation", "probed", "states", "extraction", "steered", "steering"]
PARTITIONED_BY: Mapping[str, Kind] = {
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
    "extraction_settings": "extraction",
    "probing_settings": "extraction",
    "steering_settings": "steered",
    "probe_items": "probed",
    "hidden_states": "states",
    "probes": "extraction",
    "directions": "extraction",
    "steering": "steering",
    "steering_votes": "steering",
}
TOGETHER = "tables and figures"  # one run makes any of PRINTED, since each takes less than a run's overhead
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


def steps(stages: Sequence[str] = STAGES) -> list[tuple[str, list[str]]]:
    """Stages in order with the name of what makes them: itself, or TOGETHER for all of PRINTED."""
    return [(name, list(group)) for name, group in groupby(stages, lambda s: TOGETHER if s in PRINTED else s)]


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
        case "contrasts" | "regime_tests":
            return [*(("metrics", d) for d in DATASETS), *_every_cell("verdicts")]
        case "leaderboard":
            return [*(("metrics", d) for d in DATASETS), *_every_cell("verdicts"), ("contrasts", None)]
        case "agreement" | "judge_bias":
            return [*(("items", d) for d in DATASETS), *_every_cell("votes"), ("judges", None)]
        case "leave_one_out":
            cells = [*_every_cell("votes"), *_every_cell("verdicts")]
            return [*(("items", d) for d in DATASETS), *cells, ("leaderboard", None), ("judges", None)]
        case "confabulation":
            protocol = load_protocol()
            cells = [cell.key for model in protocol.models for cell in protocol.cells(model)]
            sampled = [(s, key) for s in ("responses", "verdicts") for key in cells]
            return [*(("items", d) for d in DATASETS), *sampled, ("confabulation_protocol", None)]
        case "confabulation_prevalence":
            return [("confabulation", None)]
        case "probe_items":
            if key == ANSWERABLE:
                return [(s, c) for c in OCCLUSION_CATEGORIES for s in ("scene_specs", "videos")]
            return [("items", key)]
        case "hidden_states":
            cell = StatesCell.parse(str(key))
            return [("probe_items", cell.dataset), ("extraction_settings", cell.extraction.key)]
        case "probes":
            behaviour = [("verdicts", key) for key in standard_cells()]
            return [*_states_of(str(key)), *behaviour, ("probing_settings", key)]
        case "directions":
            return [*_states_of(str(key)), ("probing_settings", key)]
        case "cosines":
            return [("directions", extraction.key) for extraction in all_extractions()]
        case "steering":
            cell = SteeringCell.parse(str(key))
            every = [("directions", extraction.key) for extraction in all_extractions()]
            return [("items", cell.dataset), *every, ("steering_settings", cell.run)]
        case "steering_votes":
            return [("items", SteeringCell.parse(str(key)).dataset), ("steering", key), ("judges", None)]
        case "steering_effects" | "steering_shares":
            return [(stage, key) for stage in ("steering", "steering_votes") for key in keys_of("steering")]
        case "contact_sheet":
            return [("items", d) for d in DATASETS]
        case "gallery":
            return [(s, c) for c in CATEGORIES for s in ("scene_specs", "videos")]
        case "shortcuts":
            return [*(("items", d) for d in DATASETS), *(("videos", c) for c in CATEGORIES)]
        case name if name in OF_PAPER:
            return [("published", None)]
        case name if name in OF_STUDY:
            return [(s, k) for s in OF_STUDY[name].reads for k in keys_of(s)]
        case "report_page":
            items = [(s, k) for s in ("items", "responses", "votes", "verdicts") for k in keys_of(s)]
            return [*items, *((s, None) for s in ("leaderboard", "contact_sheet", "shortcuts", *PRINTED))]
    raise KeyError(f"unknown stage {stage!r}; known: {', '.join(STAGES)}")


def _every_cell(stage: str) -> list[Node]:
    return [(stage, Cell(d, e).key) for d in DATASETS for e in all_evaluations()]


def _states_of(extraction: str) -> list[Node]:
    return [("hidden_states", StatesCell(d, Extraction.parse(extraction)).key) for d in PROBED_DATASETS]


def standard_cells() -> list[str]:
    """Cells in which the local models answered under Standard in run 1: what they confabulated on there."""
    return [Cell(d, Evaluation(m, "standard", 1)).key for d in DATASETS for m in local_models()]


def partition_of(stage: str, key: str | None) -> dict[str, str | int]:
    """Values of a table's partition columns for a partition key."""
    match PARTITIONED_BY.get(stage):
        case None:
            return {}
        case "cell":
            return Cell.parse(str(key)).partition
        case "states":
            return dict(StatesCell.parse(str(key)).partition)
        case "extraction":
            return dict(Extraction.parse(str(key)).partition)
        case "steering":
            return SteeringCell.parse(str(key)).partition
        case "probed":
            return {"dataset": str(key)}
        case kind:
            return {kind: str(key)}


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
        case "probed":
            return list(PROBED_DATASETS)
        case "extraction":
            return [extraction.key for extraction in all_extractions()]
        case "states":
            return [StatesCell(d, extraction).key for d in PROBED_DATASETS for extraction in all_extractions()]
        case "steered":
            return list(all_steered())
        case "steering":
            return [f"{d}|{run}" for d in DATASETS for run in all_steered()]
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
        if stage == "hidden_states" and not states_are_there(self._workspace, StatesCell.parse(str(key))):
            reasons += ["its states are gone"]
        if stage == "directions" and not directions_are_there(self._workspace, Extraction.parse(str(key))):
            reasons += ["its directions are gone"]
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
            case "published":
                return published_digest()
            case "judge_validation":
                state = self._workspace.tables.state(JUDGE_VALIDATION, {})
                return state.version if state else "not run"
            case "confabulation_protocol":
                return protocol_digest(self._workspace.study.panel)
            case "extraction_settings":
                return extraction_version(self._workspace, Extraction.parse(str(key)))
            case "probing_settings":
                return probing_version(self._workspace, Extraction.parse(str(key)))
            case "steering_settings":
                return steering_version(self._workspace, str(key))
        raise KeyError(f"unknown source {name!r}; known: {', '.join(SOURCES)}")


def reread_sources() -> None:
    """Forget what was read of specs, corrections, prompts and registries: a server that lives long sees edits then.

    Which evaluations there are stays: partition keys are made from them when the code location is loaded.
    """
    registries = (load_models, load_accounts, load_judges, load_panel, load_protocol)
    for cached in (load_released, folded, prompt, system_prompt, vqa_prompt, *registries):
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
    """What a report (which is no table) was made from, in a folder beside it."""
    state = State(version, dict(inputs), rows=0, failed=0)
    write_text(workspace.reports / ".state" / f"{name}.json", json.dumps(asdict(state)))


def read_report_state(workspace: Workspace, name: str) -> State | None:
    """The state that `write_report_state` wrote; None if the report was never made."""
    path = workspace.reports / ".state" / f"{name}.json"
    if not path.is_file():
        return None
    try:
        return State(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise TrapsError(f"{path}: is not what was written ({error}); delete it and run again") from error
