"""The benchmark group: specs, clips, items."""

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.common import CATEGORY, DATASET, OWNERS, Checks, Events, check, table_metadata
from traps_pipeline.lineage import Lineage
from traps_pipeline.partitions import CATEGORIES, datasets_of_category
from traps_pipeline.progress import Tally
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import ITEMS, SCENE_SPECS, VIDEOS

GROUP = "benchmark"
released_specs = common.source_asset(
    "released_specs", GROUP, "Frozen scenarios under scene_specs/released, one resolved record each.", ["json"]
)
corrections = common.source_asset(
    "corrections", GROUP, "Review decisions under scene_specs/corrections, folded over the released records.", ["json"]
)
category_to_datasets = dg.StaticPartitionMapping({c: list(datasets_of_category(c)) for c in CATEGORIES})


@dg.asset(
    partitions_def=CATEGORY,
    deps=[released_specs, corrections],
    group_name=GROUP,
    kinds={"parquet", "mujoco"},
    owners=OWNERS,
    metadata=table_metadata("scene_specs"),
    output_required=False,
    check_specs=[
        check(
            "outcome_settled",
            "scene_specs",
            "Replayed from the frozen trajectory, every outcome is the ground truth, settled 0.6 s before the end.",
        ),
        check(
            "control_certified",
            "scene_specs",
            "By the evidence in each record, the control can be answered: settled in time, with a margin, legible.",
        ),
        check(
            "void_certified",
            "scene_specs",
            "By the evidence in each record, the void cannot be answered: hidden without a trace and with a twin of "
            "another answer (occlusion), futures that disagree (chaotic). `traps certify` derives it all anew.",
        ),
        check(
            "ill_posed_certified",
            "scene_specs",
            "The inventory refutes each ill-posed question, or it asks what no video shows; no well-posed one is.",
        ),
        check(
            "answers_balanced",
            "scene_specs",
            "Within a family no answer and no ill-posed text is too frequent, and no scene occurs twice (whole "
            "benchmarks only).",
        ),
    ],
)
def scene_specs(context: dg.AssetExecutionContext) -> Events:
    """Scenarios of a category after corrections, one row each; a corrected parameter is simulated here, once."""
    from traps_pipeline.benchmark import evidence
    from traps_pipeline.benchmark.composition import problems
    from traps_pipeline.benchmark.specs import build_specs, unsettled

    workspace, category = Workspace.open(), context.partition_key
    provenance = common.provenance(context, workspace)
    rows, resolved = build_specs(workspace, category)
    inputs = Lineage(workspace).inputs("scene_specs", category)
    checks = Checks(context, workspace)
    specs = [item.spec for item in resolved]
    checks.record("outcome_settled", category, unsettled(resolved))
    checks.record("control_certified", category, evidence.unanswerable_controls(specs))
    checks.record("void_certified", category, evidence.answerable_voids(specs))
    checks.record("ill_posed_certified", category, evidence.answerable_ill_posed(specs))
    checks.record("answers_balanced", category, [] if workspace.study.is_subset else problems(specs))
    version = workspace.tables.write(SCENE_SPECS, {"category": category}, rows, inputs)
    progress.current().partition("scene_specs", category, Tally())
    yield common.materialized(context, category, version, provenance, **{"dagster/partition_row_count": len(rows)})
    yield from checks.results()


@dg.asset(
    partitions_def=CATEGORY,
    deps=[scene_specs],
    group_name=GROUP,
    kinds={"parquet", "mp4"},
    owners=OWNERS,
    metadata=table_metadata("videos"),
    output_required=False,
    check_specs=[
        check(
            "panel_hides",
            "videos",
            "Nothing decisive has a pixel, shadow included, in any checked frame of an occluded void.",
        ),
        check("clips_distinct", "videos", "No two clips of a category show the same frames."),
    ],
)
def videos(context: dg.AssetExecutionContext) -> Events:
    """Control and void clips of a category, one row each; rendered from frozen trajectories, each once."""
    from traps_pipeline.benchmark.videos import build_videos

    workspace, category = Workspace.open(), context.partition_key
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("videos", category)
    rows, drawn, leaks = build_videos(workspace, category)
    shown = [(row["side"], row["frames_sha256"]) for row in rows]
    alike = [row["path"] for row, frames in zip(rows, shown, strict=True) if shown.count(frames) > 1]
    checks = Checks(context, workspace)
    checks.record("panel_hides", category, {id_: pixels for id_, pixels in leaks.items() if pixels})
    checks.record("clips_distinct", category, alike)
    version = workspace.tables.write(VIDEOS, {"category": category}, rows, inputs)
    progress.current().partition("videos", category, Tally(frames=drawn))
    size = sum(row["size_bytes"] for row in rows) / 1e6
    metadata = {"dagster/partition_row_count": len(rows), "frames rendered": drawn, "megabytes": round(size, 2)}
    yield common.materialized(context, category, version, provenance, **metadata)
    yield from checks.results()


@dg.asset(
    partitions_def=DATASET,
    deps=[
        dg.AssetDep(scene_specs, partition_mapping=category_to_datasets),
        dg.AssetDep(videos, partition_mapping=category_to_datasets),
    ],
    group_name=GROUP,
    kinds={"parquet"},
    owners=OWNERS,
    metadata=table_metadata("items"),
    output_required=False,
    check_specs=[
        check("two_items_a_pair", "items", "Every pair has one control and one void item."),
        check(
            "clips_present",
            "items",
            "Every clip is there with its digest (checked while building; a damaged one fails the step).",
        ),
    ],
)
def items(context: dg.AssetExecutionContext) -> Events:
    """Questions put to models, two a pair: the control and the void that differs from it by one change."""
    from traps_pipeline.benchmark.items import build_items

    workspace, dataset = Workspace.open(), context.partition_key
    provenance = common.provenance(context, workspace)
    inputs = Lineage(workspace).inputs("items", dataset)
    rows = build_items(workspace, dataset)
    checks = Checks(context, workspace)
    sides: dict[str, list[str]] = {}
    for row in rows:
        sides.setdefault(row["pair_id"], []).append(row["side"])
    odd = {pair: found for pair, found in sides.items() if sorted(found) != ["control", "void"]}
    checks.record("two_items_a_pair", dataset, odd)
    absent = sorted({row["clip"] for row in rows if not workspace.resolve(row["clip"]).is_file()})
    checks.record("clips_present", dataset, absent)
    version = workspace.tables.write(ITEMS, {"dataset": dataset}, rows, inputs)
    progress.current().partition("items", dataset, Tally())
    metadata = {"dagster/partition_row_count": len(rows), "benchmark version": rows[0]["benchmark_version"]}
    yield common.materialized(context, dataset, version, provenance, **metadata)
    yield from checks.results()
