"""Build the rows of a release from the tables of a study with rendered clips."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.yamlfile import read_yaml
from traps_pipeline.benchmark.corrections import load_two_events
from traps_pipeline.benchmark.held_out import opaque_name
from traps_pipeline.benchmark.records import Release, load_release
from traps_pipeline.benchmark.specs import spec_of
from traps_pipeline.benchmark.stored_evidence import judged_certificates
from traps_pipeline.judging.panel import tasks_for
from traps_pipeline.models.registry.prompts import load_prompt, system_prompt
from traps_pipeline.people.recorded_certificates import recorded_verdicts
from traps_pipeline.pipeline.experiment import LITE_FILE
from traps_pipeline.protocol.datasets import ARMS, DATASETS, TWO_EVENTS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.release.held_out_clips import clip_name
from traps_pipeline.release.released_rows import (
    PAIRS,
    CertificateRow,
    HeldOutItemRow,
    PairRow,
    PromptRow,
    ReleasedItemRow,
    ScenarioRow,
    SplitRow,
    TwoEventsRow,
)
from traps_pipeline.scenes.worlds.lane_records import TwoEventsSpec
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.storage.benchmark_tables import ITEMS, SCENE_SPECS
from traps_pipeline.storage.tables import records
from traps_pipeline.storage.workspace import Workspace

CLIPS = "clips"
PROMPT_LICENCE = "CC-BY-NC-4.0"
SYSTEM, JUDGE = "system prompt of a model", "prompt of a judge"
_CLIPS = f"{CLIPS}/"
_SIMULATED = {"source": "simulated", "licence": "CC-BY-4.0"}  # of clips that nobody recorded

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Content:
    """A release's content: the study's folder, ITEMS and SCENE_SPECS rows, clips by path, benchmark, two events.

    people: by recorded scenario why people do not certify it, None where they do.
    """

    study: Path
    items: Rows
    specs: Rows
    clips: Mapping[str, Path]
    release: Release
    two_events: Sequence[TwoEventsSpec] = ()
    people: Mapping[str, str | None] = field(default_factory=dict)

    @property
    def versions(self) -> dict[str, str]:
        """The benchmark version of each dataset and arm."""
        return {str(row["dataset"]): str(row["benchmark_version"]) for row in self.items}


def content_of(workspace: Workspace, arms: Sequence[str] = ()) -> Content:
    """Return a study's pairs, its two events and these arms' items. Raises TrapsError if unsound."""
    items = _records(workspace, ITEMS, (*DATASETS, TWO_EVENTS, *arms))
    if not any(row["dataset"] in DATASETS for row in items):
        raise TrapsError(f"{workspace.root}: no pairs to release; make items first (traps run ... --until items)")
    for arm in arms:
        if arm not in ARMS or arm not in {row["dataset"] for row in items}:
            raise TrapsError(
                f"{workspace.root}: has no items of the arm {arm[:40]!r}; known arms: {', '.join(ARMS)}. Name it among "
                "the datasets of an experiment and run that, or leave it out"
            )
    specs = [spec for spec in _records(workspace, SCENE_SPECS) if spec["scenario_id"] in _ids(items)]
    clips = {str(row["clip"]): workspace.resolve(str(row["clip"])) for row in items}
    for row in items:
        path = clips[row["clip"]]
        if not path.is_file() or file_digest(path) != row["media_digest"]:
            raise TrapsError(f"{path}: is missing or not the clip of its item; materialize videos again")
    lanes = load_two_events(workspace.study)
    two_events = [lanes[id_].spec for id_ in sorted(_ids(row for row in items if row["dataset"] == TWO_EVENTS))]
    people = recorded_verdicts(workspace.tables)
    return Content(workspace.root, items, specs, clips, load_release(), two_events, people)


def _records(workspace: Workspace, table: Any, datasets: Sequence[str] | None = None) -> list[dict[str, Any]]:
    frame = workspace.tables.read_all(table, **({} if datasets is None else {"dataset": tuple(datasets)}))
    return sorted(records(frame), key=lambda row: [row[name] for name in table.key])


def _ids(items: Iterable[Mapping[str, Any]]) -> set[str]:
    return {str(row["scenario_id"]) for row in items}


def lite_of(items: Iterable[Mapping[str, Any]]) -> set[str]:
    """Return the scenarios of the lite set that are among the items."""
    return _ids(items) & {*read_yaml(LITE_FILE)["scenarios"]}


# --- rows -------------------------------------------------------------------------------------------------------------


def pair_rows(content: Content) -> list[PairRow]:
    """Return one row per pair, sorted by id. Raises TrapsError for a missing side."""
    lite_scenarios, rows, pairs = lite_of(content.items), list[PairRow](), dict[str, dict[str, Mapping[str, Any]]]()
    for row in content.items:
        if row["dataset"] in DATASETS:
            pairs.setdefault(row["pair_id"], {})[row["side"]] = row
    evidence = {row["scenario_id"]: json.loads(row["evidence"]) for row in content.specs}
    for pair_id, sides in sorted(pairs.items()):
        if len(sides) < 2:
            raise TrapsError(f"{pair_id}: only its {next(iter(sides))} is there; make items again")
        control, void = sides["control"], sides["void"]
        rows.append(
            PairRow(
                **{name: control[name] for name in PAIRS.names if name in control},
                control_item_id=control["item_id"],
                void_item_id=void["item_id"],
                control_file_name=control["clip"],
                void_file_name=void["clip"],
                control_question=control["question"],
                void_question=void["question"],
                lite=control["scenario_id"] in lite_scenarios,
                **{name: evidence[control["scenario_id"]].get(name, own) for name, own in _SIMULATED.items()},
                canary=content.release.canary,
            )
        )
    return rows


def item_rows(content: Content) -> list[ReleasedItemRow]:
    """Return the rows of a release's table of items, one an item, sorted by id."""
    lite_scenarios = lite_of(content.items)
    return [
        ReleasedItemRow(
            **row,
            file_name=row["clip"].removeprefix(_CLIPS),
            lite=row["scenario_id"] in lite_scenarios,
            canary=content.release.canary,
        )
        for row in content.items
    ]


def held_out_rows(items: Rows, digests: Mapping[str, str], key: bytes, canary: str) -> list[HeldOutItemRow]:
    """Return one row per item, sorted by opaque name; no field reveals the answer. digests: of each item's own clip."""
    rows = [
        HeldOutItemRow(
            item=opaque_name(key, row["item_id"]),
            question=row["question"],
            file_name=f"items/{clip_name(digests[row['item_id']])}",
            media_digest=digests[row["item_id"]],
            canary=canary,
        )
        for row in items
    ]
    return sorted(rows, key=lambda row: row.item)


def scenario_rows(content: Content) -> list[ScenarioRow]:
    """Return one row per scenario: its complete record."""
    return [ScenarioRow(**row, canary=content.release.canary) for row in content.specs]


def two_events_rows(content: Content) -> list[TwoEventsRow]:
    """Return one row per scenario of two events: its record."""
    return [
        TwoEventsRow(scenario_id=spec.scenario_id, record=spec.model_dump_json(), canary=content.release.canary)
        for spec in content.two_events
    ]


def certificate_rows(content: Content) -> list[CertificateRow]:
    """Return one row per certificate and scenario, evaluated on the record's numbers."""
    events = [spec for spec in content.two_events if spec.scenario_id in content.people]
    specs = [*(spec_of(dict(row)) for row in content.specs), *events]
    return [row for spec in specs for row in _certificates(spec, content)]


def _certificates(spec: SceneSpec | TwoEventsSpec, content: Content) -> Iterable[CertificateRow]:
    def row(name: str, about: str, promises: str, failure: str | None, evidence: Mapping[str, Any]) -> CertificateRow:
        return CertificateRow(
            scenario_id=spec.scenario_id,
            certificate=name,
            about=about,
            promises=" ".join(promises.split()),
            holds=failure is None,
            failure=failure,
            evidence=json.dumps(evidence, sort_keys=True, ensure_ascii=False, default=list),
            canary=content.release.canary,
        )

    if isinstance(spec, TwoEventsSpec) or spec.is_recorded:
        promises = "People who saw one clip at a time answered the control rightly and could not know the void."
        yield row("people", "void", promises, content.people[spec.scenario_id], spec.evidence)
        return
    for certificate, evidence, failure in judged_certificates(spec):
        numbers = {n.name: evidence[n.name] for n in certificate.numbers if n.name in evidence}
        yield row(certificate.name, certificate.about, certificate.promises, failure, numbers)


def split_rows(content: Content) -> list[SplitRow]:
    """Return one row per scenario and split."""
    splits = {"lite": lite_of(content.items), "test": _ids(content.items)}
    return [
        SplitRow(split=name, scenario_id=id_, canary=content.release.canary)
        for name, ids in splits.items()
        for id_ in sorted(ids)
    ]


def prompt_rows(canary: str) -> list[PromptRow]:
    """Return one row per system prompt: of each regime, and of each task of the panel."""
    texts = {(JUDGE, task): load_prompt(f"judge_{task}") for task in tasks_for("control")}
    texts[JUDGE, "premise"] = load_prompt("judge_premise_suffix")
    texts |= {(SYSTEM, regime): system_prompt(regime) for regime in REGIMES}
    return [
        PromptRow(name=name, role=role, text=text, version=digest(text)[:16], licence=PROMPT_LICENCE, canary=canary)
        for (role, name), text in sorted(texts.items())
    ]
