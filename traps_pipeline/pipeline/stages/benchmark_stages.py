"""The benchmark group: specs, clips, items."""

from collections import Counter
from collections.abc import Callable
from typing import Any

from traps_pipeline.base.progress import Tally
from traps_pipeline.benchmark.composition import problems
from traps_pipeline.benchmark.specs import build_specs, corrections_version, released_version, seconds_left, unsettled
from traps_pipeline.benchmark.videos import missing_clips
from traps_pipeline.pipeline.graph import Check, ConcurrentBuild, RunResources
from traps_pipeline.pipeline.schemes import CATEGORY, DATASET, to_keys
from traps_pipeline.pipeline.stage import is_declared, of, source, stage
from traps_pipeline.protocol.datasets import all_datasets_of, beside_of, sides_of, taxonomy_of_category
from traps_pipeline.storage.benchmark_tables import ARMS, ITEMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

GROUP = "benchmark"
RENDERS = RunResources(memory_gb=0.6, each_gb=0.4)  # measured: 0.4 GB of the process, 0.35 of each that draws
released_specs = source(
    "released_specs",
    released_version,
    group=GROUP,
    doc="Frozen scenarios under scene_specs/released, one resolved record each.",
    kinds=["json"],
    scheme=CATEGORY,
)
corrections = source(
    "corrections",
    corrections_version,
    group=GROUP,
    doc="Review decisions under scene_specs/corrections, folded over the released records.",
    kinds=["json"],
    scheme=CATEGORY,
)
category_to_datasets = to_keys(CATEGORY, DATASET, all_datasets_of)
category_to_arms = to_keys(CATEGORY, DATASET, lambda category: beside_of(taxonomy_of_category(category)))


def _make_specs(workspace: Workspace, category: str) -> StageOutput:
    """Return scenarios of a category after corrections, one row each; a scenario with corrected parameters is simulated
    here, once."""
    rows, resolved = build_specs(workspace, category)
    return StageOutput(rows, beside=resolved)


def _evidence(find: str) -> Callable[[Workspace, str | None, StageOutput], Any]:
    def wrong(workspace: Workspace, key: str | None, output: StageOutput) -> Any:
        from traps_pipeline.benchmark import stored_evidence as evidence

        return getattr(evidence, find)([item.spec for item in output.beside])

    return wrong


scene_specs = stage(
    SCENE_SPECS,
    _make_specs,
    group=GROUP,
    parents=[released_specs, corrections],
    scheme=CATEGORY,
    code="4",
    kinds=["parquet", "mujoco"],
    shared=ConcurrentBuild(seconds=seconds_left),
    checks=[
        Check(
            "outcome_settled",
            "In the replay of the frozen trajectory, every outcome is the ground truth, is settled in time, and has "
            "the margin in its record.",
            lambda workspace, key, made: unsettled(made.beside),
        ),
        Check(
            "control_certified",
            "By the evidence in each record, the control can be answered: its outcome is settled in time, with a "
            "margin, and legible.",
            _evidence("unanswerable_controls"),
        ),
        Check(
            "void_certified",
            "By the evidence in each record, the void cannot be answered: the outcome is hidden without a trace and a "
            "twin has another answer (occlusion), or futures disagree (chaotic); nor can a control that a panel closes "
            "be answered from its last frame. `traps benchmark certify` computes this again.",
            _evidence("answerable_voids"),
        ),
        Check(
            "ill_posed_certified",
            "The inventory refutes each ill-posed question, or the question asks for what no video shows; neither "
            "holds for a well-posed question.",
            _evidence("answerable_ill_posed"),
        ),
        Check(
            "answers_balanced",
            "Within a family no answer and no ill-posed text is too frequent, and no scene occurs twice (whole "
            "benchmarks only).",
            lambda workspace, key, made: (
                [] if workspace.study.is_subset else problems([item.spec for item in made.beside])
            ),
            blocks=False,
        ),
    ],
)


def _make_videos(workspace: Workspace, category: str) -> StageOutput:
    """Return control and void clips of a category, one row each; each is rendered once, from its frozen trajectory, by
    whichever of the processes that are at it."""
    from traps_pipeline.benchmark.videos import build_videos

    rows, leaks = build_videos(workspace, category)
    return StageOutput(rows, shown={"megabytes": round(sum(row.size_bytes for row in rows) / 1e6, 2)}, beside=leaks)


def _render(workspace: Workspace, category: str, wait: bool) -> tuple[Tally, bool]:
    from traps_pipeline.benchmark.videos import render_videos

    frames, is_whole = render_videos(workspace, category, wait=wait)
    return Tally(frames=frames), is_whole


def _to_render_s(workspace: Workspace, category: str) -> float:
    from traps_pipeline.benchmark.videos import seconds_left

    return seconds_left(workspace, category)


def _alike(workspace: Workspace, key: str | None, output: StageOutput) -> list[str]:
    counts = Counter((row.side, row.frames_sha256) for row in output.rows(VIDEOS))
    return [row.path for row in output.rows(VIDEOS) if counts[row.side, row.frames_sha256] > 1]


videos = stage(
    VIDEOS,
    _make_videos,
    group=GROUP,
    parents=[scene_specs],
    scheme=CATEGORY,
    code="3",
    kinds=["parquet", "mp4"],
    takes=RENDERS,
    shared=ConcurrentBuild(_render, _to_render_s),
    lost=lambda workspace, key: [f"clip {path} is gone or damaged" for path in missing_clips(workspace, str(key))],
    checks=[
        Check(
            "panel_hides",
            "Nothing decisive has a pixel, shadow included, in any checked frame of an occluded void.",
            lambda workspace, key, made: {id_: pixels for id_, pixels in made.beside.items() if pixels},
        ),
        Check("clips_distinct", "No two clips of a category show the same frames.", _alike, blocks=False),
    ],
)


def _make_arms(workspace: Workspace, category: str) -> StageOutput:
    """Return the arms and variations of a category's scenarios that the study asks: clips and questions beside the
    pairs."""
    from traps_pipeline.benchmark.filmed_arms import build_arms

    rows = build_arms(workspace, category)
    admitted = sum(row.refused is None for row in rows)
    return StageOutput(rows, shown={"admitted": admitted, "refused": len(rows) - admitted})


def _film(workspace: Workspace, category: str, wait: bool) -> tuple[Tally, bool]:
    from traps_pipeline.benchmark.filmed_arms import film_arms

    frames, is_whole = film_arms(workspace, category, wait=wait)
    return Tally(frames=frames), is_whole


def _to_film_s(workspace: Workspace, category: str) -> float:
    from traps_pipeline.benchmark.filmed_arms import seconds_left

    return seconds_left(workspace, category)


def _unmade_arms(workspace: Workspace, category: str) -> list[str]:
    from traps_pipeline.benchmark.filmed_arms import unmade

    return unmade(workspace, category)


arms = stage(
    ARMS,
    _make_arms,
    group="arms",
    parents=[scene_specs, videos],
    scheme=CATEGORY,
    code="3",
    kinds=["parquet", "mp4"],
    takes=RENDERS,
    shared=ConcurrentBuild(_film, _to_film_s),
    wants=lambda wanted, key: bool({*wanted.arms} & {*beside_of(taxonomy_of_category(str(key)))}),
    lost=lambda workspace, key: _unmade_arms(workspace, str(key)),
)


def _make_items(workspace: Workspace, dataset: str) -> StageOutput:
    """Return the items that models are asked, two per pair: the control, and the void that differs from it by one
    change."""
    from traps_pipeline.benchmark.items import build_items

    rows = build_items(workspace, dataset)
    return StageOutput(rows, shown={"benchmark version": rows[0].benchmark_version})


def _odd_pairs(workspace: Workspace, key: str | None, output: StageOutput) -> dict[str, list[str]]:
    sides: dict[str, list[str]] = {}
    for row in output.rows(ITEMS):
        sides.setdefault(row.pair_id, []).append(row.side)
    return {pair: found for pair, found in sides.items() if tuple(sorted(found)) != sides_of(str(key))}


items = stage(
    ITEMS,
    _make_items,
    group=GROUP,
    parents=[
        of(scene_specs, category_to_datasets),
        of(videos, category_to_datasets),
        *([of(arms, category_to_arms)] if is_declared("arms") else []),
    ],
    scheme=DATASET,
    checks=[
        Check(
            "two_items_a_pair",
            "Every pair has one control and one void item, and every arm has items of its sides.",
            _odd_pairs,
        ),
        Check(
            "clips_present",
            "Every clip exists and has its digest (checked while the table is made; a damaged clip fails the step).",
            lambda workspace, key, made: sorted(
                (named := {row.clip for row in made.rows(ITEMS)}) - workspace.sizes(named).keys()
            ),
        ),
    ],
)
