"""Turn scenarios and clips into questions, two per pair (docs/spec.md 1 and 2)."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import TWO_EVENTS_RELEASED
from traps_pipeline.benchmark.corrections import load_two_events
from traps_pipeline.benchmark.filmed_lanes import lane_specs, lanes_version
from traps_pipeline.benchmark.held_out import released_only
from traps_pipeline.benchmark.records import two_events_lines
from traps_pipeline.benchmark.specs import expected_specs, released_in_study
from traps_pipeline.benchmark.versions import item_content, spec_record, version_of
from traps_pipeline.protocol.datasets import (
    ALL_CATEGORIES,
    GRADED,
    SIDES,
    TWO_EVENTS,
    UNPAIRED,
    all_datasets_of,
    is_ill_posed,
    taxonomy_of_category,
)
from traps_pipeline.protocol.two_events import LANES, LaneItem
from traps_pipeline.scenes.family_registry import get_family
from traps_pipeline.scenes.worlds.clip_notes import check_clip
from traps_pipeline.scenes.worlds.lane_records import RecordedEvents, TwoEventsSpec
from traps_pipeline.storage.benchmark_tables import ARMS as ARMS_TABLE
from traps_pipeline.storage.benchmark_tables import ITEMS, SCENE_SPECS, VIDEOS, ItemRow
from traps_pipeline.storage.tables import records
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.video.encode import DamagedClip

Record = Mapping[str, Any]


def categories_of_dataset(dataset: str) -> list[str]:
    """Return the categories whose scenarios form a dataset."""
    return [category for category in ALL_CATEGORIES if dataset in all_datasets_of(category)]


def build_items(workspace: Workspace, dataset: str) -> list[ItemRow]:
    """Return a dataset's rows of ITEMS, with clips verified by digest. Raises TrapsError."""
    specs: list[Record] = []
    clips: dict[tuple[str, str], Record] = {}
    for category in categories_of_dataset(dataset):
        if workspace.tables.state(SCENE_SPECS, {"category": category}) is None:
            continue
        specs += workspace.tables.read(SCENE_SPECS, {"category": category}).to_dict("records")
        for row in workspace.tables.read(VIDEOS, {"category": category}).to_dict("records"):
            clips[row["scenario_id"], row["side"]] = row
    if dataset == TWO_EVENTS:
        return released_only(workspace.root, _lane_items(workspace))
    if not specs:
        raise TrapsError(f"items {dataset}: no scene_specs yet; materialize scene_specs and videos first")
    if dataset not in UNPAIRED:
        _check_clips(workspace, dataset, specs, clips)
    released_specs = [s for c in categories_of_dataset(dataset) for s in released_in_study(workspace, c).values()]
    version = version_of(
        (item_content(dataset, spec_record(spec)) for spec in released_specs),
        (item_content(dataset, row) for row in specs),
    )
    commonest = commonest_answers(specs)
    if dataset in UNPAIRED:
        rows = _arm_items(workspace, dataset, {spec["scenario_id"]: spec for spec in specs}, commonest, version)
    else:
        rows = [_item(dataset, spec, side, clips, commonest, version) for spec in specs for side in SIDES]
    return released_only(workspace.root, rows)


def expected_items(workspace: Workspace, dataset: str) -> list[dict[str, Any]]:
    """Return a dataset's rows of ITEMS as a run would build them, without building any.

    It uses the clips that exist: items whose clip must be rendered first are left out, and of arms those of changed
    scenarios. Raises TrapsError.
    """
    if dataset == TWO_EVENTS:
        lanes = [scenario.spec for scenario in load_two_events(workspace.study).values()]
        current = {(asked.item.item_id, asked.text, tuple(spec.labels)) for spec in lanes for asked in spec.questions()}
        rows = records(workspace.tables.read_all(ITEMS, dataset=dataset))
        return [row for row in rows if (row["item_id"], row["question"], tuple(row["labels"])) in current]
    specs = [asdict(row) for category in categories_of_dataset(dataset) for row in expected_specs(workspace, category)]
    if dataset in UNPAIRED:
        stored_hashes = workspace.tables.read_all(SCENE_SPECS, ["spec_hash"])["spec_hash"]
        unchanged = {spec["scenario_id"] for spec in specs if spec["spec_hash"] in {*stored_hashes}}
        rows = records(workspace.tables.read_all(ITEMS, dataset=dataset))
        return [row for row in rows if row["scenario_id"] in unchanged]
    scenes = {spec["scenario_id"]: spec["scene_hash"] for spec in specs}
    clips: dict[tuple[str, str], Record] = {
        (row["scenario_id"], row["side"]): row
        for row in workspace.tables.read_all(VIDEOS, category=categories_of_dataset(dataset)).to_dict("records")
        if row["scene_hash"] == scenes.get(row["scenario_id"])
    }
    complete_specs = [spec for spec in specs if all((spec["scenario_id"], side) in clips for side in SIDES)]
    commonest = commonest_answers(specs)
    rows = [_item(dataset, spec, side, clips, commonest, "") for spec in complete_specs for side in SIDES]
    return [asdict(row) for row in released_only(workspace.root, rows)]


def _arm_rows(workspace: Workspace, arm: str) -> list[Record]:
    """Return an arm's rows of the arms tables that exist."""
    made = [c for c in categories_of_dataset(arm) if workspace.tables.state(ARMS_TABLE, {"category": c}) is not None]
    rows = (row for category in made for row in records(workspace.tables.read(ARMS_TABLE, {"category": category})))
    return [row for row in rows if row["arm"] == arm]


def _arm_items(
    workspace: Workspace, arm: str, specs: Mapping[str, Record], commonest: Mapping[str, str], version: str
) -> list[ItemRow]:
    """Return items with the arms table's questions, per scenario that admits the arm."""
    rows = [row for row in _arm_rows(workspace, arm) if row["refused"] is None]
    if not rows:
        raise TrapsError(f"items {arm}: no scenario of this study admits it; take more scenarios or leave the arm out")
    return [_arm_item(specs[row["scenario_id"]], row, commonest, version) for row in rows]


def _lane_items(workspace: Workspace) -> list[ItemRow]:
    """Return the eight items of each scenario of two events in the study."""
    categories = categories_of_dataset(TWO_EVENTS)
    specs = {id_: spec for category in categories for id_, spec in lane_specs(workspace, category).items()}
    rows = _arm_rows(workspace, TWO_EVENTS)
    if not two_events_lines():
        raise TrapsError(
            f"{TWO_EVENTS_RELEASED}: holds no records of two events, as a benchmark drawn before 0.4.0; add some by "
            f"`traps benchmark sample --two-events 8` or an import, or leave {TWO_EVENTS} out of the datasets"
        )
    if not rows:
        raise TrapsError(
            f"items {TWO_EVENTS}: the study has no scenario of two events; name some (as chain-e001) among its "
            "scenarios, or leave the dataset out"
        )
    if lost := {*specs} - {row["scenario_id"] for row in rows}:
        raise TrapsError(f"items {TWO_EVENTS}: {min(lost)} was not filmed; materialize arms")
    answers = [
        {"sub_scenario": _sub_scenario(spec), "ground_truth": lane.ground_truth}
        for spec in specs.values()
        for lane in spec.lanes
    ]
    commonest, version = commonest_answers(answers), lanes_version(workspace, categories)
    return [_lane_item(specs[row["scenario_id"]], row, commonest, version) for row in rows]


def _sub_scenario(spec: TwoEventsSpec) -> str:
    return spec.kind if isinstance(spec, RecordedEvents) else get_family(spec.family).sub_scenario


def _lane_item(spec: TwoEventsSpec, row: Record, commonest: Mapping[str, str], version: str) -> ItemRow:
    item = LaneItem(spec.scenario_id, *str(row["item"]).split("."))
    words = {"sub_scenario": _sub_scenario(spec), "labels": row["labels"], "aliases": json.dumps(spec.aliases)}
    decisive = _decisive(
        {**spec.model_dump(exclude={"lanes"}), **words, "taxonomy": taxonomy_of_category(spec.category)},
        dataset=TWO_EVENTS,
        side=item.side,
        question=row["question"],
        ground_truth=row["ground_truth"],
        control_answer=spec.lanes[LANES.index(item.lane)].ground_truth,
        media_digest=row["media_digest"],
    )
    return _row(decisive | {"item_id": item.item_id, "pair_id": item.pair_id}, words, commonest, row["clip"], version)


def _arm_item(spec: Record, row: Record, commonest: Mapping[str, str], version: str) -> ItemRow:
    decisive: dict[str, Any] = _decisive(
        {**spec, "labels": row["labels"]},
        dataset=row["arm"],
        side=row["side"],
        question=row["question"],
        ground_truth=row["ground_truth"],
        control_answer=row["ground_truth"] or spec["ground_truth"],
        media_digest=row["media_digest"],
    )
    item = _row(decisive, spec, commonest, row["clip"], version)
    if row["arm"] == GRADED:  # its score depends on how probable each answer is
        return replace(item, item_hash=digest([item.item_hash, json.loads(row["evidence"])["posterior"]]))
    return item


def commonest_answers(specs: Sequence[Record]) -> dict[str, str]:
    """Return each sub-scenario's commonest control answer; ties alphabetically."""
    counts: dict[str, Counter[str]] = {}
    for spec in specs:
        counts.setdefault(spec["sub_scenario"], Counter())[spec["ground_truth"]] += 1
    return {name: min(count, key=lambda answer: (-count[answer], answer)) for name, count in counts.items()}


def _check_clips(
    workspace: Workspace, dataset: str, specs: Sequence[Record], clips: Mapping[tuple[str, str], Record]
) -> None:
    digests = workspace.store.digests(workspace.root / clip["path"] for clip in clips.values())
    for spec in specs:
        for side in SIDES:
            clip = clips.get((spec["scenario_id"], side))
            if clip is None or clip["scene_hash"] != spec["scene_hash"]:
                raise TrapsError(
                    f"items {dataset}: the {side} clip of {spec['scenario_id']} is not of its current scene; "
                    f"materialize videos for {spec['category']}"
                )
            if digests.get(workspace.root / clip["path"]) == clip["file_sha256"]:
                continue
            try:
                check_clip(workspace.resolve(clip["path"]), clip["file_sha256"], clip["size_bytes"])
            except DamagedClip as error:
                raise TrapsError(str(error)) from error


def _item(
    dataset: str,
    spec: Record,
    side: str,
    clips: Mapping[tuple[str, str], Record],
    commonest: Mapping[str, str],
    version: str,
) -> ItemRow:
    unanswerable = side == "void" and is_ill_posed(dataset)
    clip = clips[spec["scenario_id"], "control" if is_ill_posed(dataset) else side]
    decisive = _decisive(
        spec,
        dataset=dataset,
        side=side,
        question=spec["ill_posed_question"] if unanswerable else spec["question"],
        ground_truth=spec["ground_truth"] if side == "control" else None,
        control_answer=spec["ground_truth"],
        media_digest=clip["file_sha256"],
    )
    return _row(decisive, spec, commonest, clip["path"], version)


def _decisive(
    spec: Record,
    *,
    dataset: str,
    side: str,
    question: str,
    ground_truth: str | None,
    control_answer: str,
    media_digest: str,
) -> dict[str, Any]:
    """Return every property of an item that decides its answer or its score."""
    return {
        "item_id": f"{dataset}:{spec['scenario_id']}:{side}",
        "pair_id": f"{dataset}:{spec['scenario_id']}",
        "dataset": dataset,
        "scenario_id": spec["scenario_id"],
        "side": side,
        "taxonomy": spec["taxonomy"],
        "category": spec["category"],
        "sub_scenario": spec["sub_scenario"],
        "question": question,
        "labels": list(spec["labels"]),
        "aliases": spec["aliases"],
        "answer_type": spec["answer_type"],
        "ground_truth": ground_truth,
        "control_answer": control_answer,
        "media_digest": media_digest,
    }


_DECISIVE = (
    *("item_id", "pair_id", "dataset", "scenario_id", "side", "taxonomy", "category", "sub_scenario", "question"),
    *("labels", "aliases", "answer_type", "ground_truth", "control_answer", "media_digest"),
)


def item_hash(row: Record) -> str:
    """Return the digest of everything that decides an item's answer or score."""
    decisive = {name: row[name] for name in _DECISIVE}
    return digest(decisive | {"labels": list(row["labels"]), "aliases": json.loads(row["aliases"])})


def _row(decisive: dict[str, Any], spec: Record, commonest: Mapping[str, str], clip: str, version: str) -> ItemRow:
    return ItemRow(
        **decisive,
        item_hash=item_hash(decisive),
        commonest_answer=commonest[spec["sub_scenario"]],
        clip=clip,
        benchmark_version=version,
    )
