"""Declare the benchmark group: specs, clips, items."""

from collections import Counter
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

from traps_pipeline.base.progress import Tally
from traps_pipeline.benchmark.specs import (
    build_specs,
    corrections_version,
    released_version,
    seconds_left,
    unsettled_outcomes,
)
from traps_pipeline.pipeline.graph import Check, ConcurrentBuild, RunResources
from traps_pipeline.pipeline.schemes import CATEGORY, DATASET, to_keys
from traps_pipeline.pipeline.stage import dep, is_declared, source, stage
from traps_pipeline.protocol.datasets import all_datasets_of, arms_of_category, sides_of
from traps_pipeline.storage.benchmark_tables import ARMS, ITEMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

RENDERS = RunResources(
    memory_gb=0.6, each_gb=0.4
)  # measured: 0.4 GB for the process, 0.35 GB for each rendering worker
_stage = partial(stage, group="benchmark")
_source = partial(source, group="benchmark", kinds=["json"], scheme=CATEGORY)
category_to_datasets = to_keys(CATEGORY, DATASET, all_datasets_of)
category_to_arms = to_keys(CATEGORY, DATASET, arms_of_category)


@_source()
def released_specs(workspace: Workspace, category: str) -> str:
    """Return the version (digest) of the frozen scenarios under scene_specs/released."""
    return released_version(workspace, category)


@_source()
def corrections(workspace: Workspace, category: str) -> str:
    """Return the version (digest) of the review decisions under scene_specs/corrections."""
    return corrections_version(workspace, category)


def _specs_check(find: str, *about: str) -> Callable[[Workspace, str | None, StageOutput], Any]:
    """Return a check by what `find` (module.function of `benchmark`) finds wrong in a table's simulated records."""
    module, _, name = find.partition(".")

    def wrong(workspace: Workspace, key: str | None, output: StageOutput) -> Any:
        function = getattr(import_module(f"traps_pipeline.benchmark.{module}"), name)
        return function([item.spec for item in output.beside if not item.spec.is_recorded], *about)

    return wrong


_unbalanced = _specs_check("composition.composition_problems")


@_stage(
    SCENE_SPECS,
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
            lambda workspace, key, output: unsettled_outcomes(output.beside),
        ),
        Check(
            "control_certified",
            "By the evidence in each record, the control can be answered: its outcome is settled in time, with a "
            "margin, and legible.",
            _specs_check("stored_evidence.failed_certificates", "control"),
        ),
        Check(
            "void_certified",
            "By the evidence in each record, the void cannot be answered: the outcome is hidden without a trace and a "
            "twin has another answer (occlusion), or futures disagree (chaotic); nor can a control that an occluder "
            "closes be answered from its last frame. `traps benchmark certify` computes this again.",
            _specs_check("stored_evidence.failed_certificates", "void", "twin", "worlds"),
        ),
        Check(
            "ill_posed_certified",
            "The inventory refutes each ill-posed question, or the question asks for what no video shows; neither "
            "holds for a well-posed question.",
            _specs_check("stored_evidence.failed_certificates", "words"),
        ),
        Check(
            "answers_balanced",
            "Within a family no answer and no ill-posed text is too frequent, and no scene occurs twice (whole "
            "benchmarks only).",
            lambda workspace, key, output: [] if workspace.study.is_subset else _unbalanced(workspace, key, output),
            blocks=False,
        ),
    ],
)
def scene_specs(workspace: Workspace, category: str) -> StageOutput:
    """Return a category's scenarios after corrections, one row each.

    A scenario with corrected parameters is simulated here, once.
    """
    rows, resolved_scenarios = build_specs(workspace, category)
    return StageOutput(rows, beside=resolved_scenarios)


def _render(workspace: Workspace, category: str, wait: bool) -> tuple[Tally, bool]:
    from traps_pipeline.benchmark.videos import render_videos

    frames, is_whole = render_videos(workspace, category, wait=wait)
    return Tally(frames=frames), is_whole


def _seconds_of_rendering(workspace: Workspace, category: str) -> float:
    from traps_pipeline.benchmark.videos import seconds_left

    return seconds_left(workspace, category)


def _lost_clips(workspace: Workspace, category: str) -> list[str]:
    from traps_pipeline.benchmark.lost_clips import missing_clips

    return [f"clip {path} is gone or damaged" for path in missing_clips(workspace, category)]


def _repeated_content(workspace: Workspace, key: str | None, output: StageOutput) -> list[str]:
    counts = Counter((row.side, row.frames_sha256) for row in output.rows(VIDEOS))
    return [row.path for row in output.rows(VIDEOS) if counts[row.side, row.frames_sha256] > 1]


@_stage(
    VIDEOS,
    parents=[scene_specs],
    scheme=CATEGORY,
    code="3",
    kinds=["parquet", "mp4"],
    takes=RENDERS,
    shared=ConcurrentBuild(_render, _seconds_of_rendering),
    lost=_lost_clips,
    checks=[
        Check(
            "occluder_hides",
            "Nothing decisive has a pixel, shadow included, in any checked frame of an occluded void.",
            lambda workspace, key, output: {id_: pixels for id_, pixels in output.beside.items() if pixels},
        ),
        Check("clips_distinct", "No two clips of a category show the same frames.", _repeated_content, blocks=False),
    ],
)
def videos(workspace: Workspace, category: str) -> StageOutput:
    """Return a category's clips, one row each: the control and the void of every scenario.

    Each clip is rendered once, from its frozen trajectory, by one of the processes working on the category.
    """
    from traps_pipeline.benchmark.videos import build_videos

    rows, leaks = build_videos(workspace, category)
    return StageOutput(rows, shown={"megabytes": round(sum(row.size_bytes for row in rows) / 1e6, 2)}, beside=leaks)


def _film(workspace: Workspace, category: str, wait: bool) -> tuple[Tally, bool]:
    from traps_pipeline.benchmark.filmed_arms import film_arms

    frames, is_whole = film_arms(workspace, category, wait=wait)
    return Tally(frames=frames), is_whole


def _seconds_of_filming(workspace: Workspace, category: str) -> float:
    from traps_pipeline.benchmark.filmed_arms import seconds_left

    return seconds_left(workspace, category)


def _lost_arms(workspace: Workspace, category: str) -> list[str]:
    from traps_pipeline.benchmark.filmed_arms import incomplete_reasons

    return incomplete_reasons(workspace, category)


@_stage(
    ARMS,
    group="arms",
    parents=[scene_specs, videos, released_specs, corrections],  # records of two events are in no table before
    scheme=CATEGORY,
    code="6",
    kinds=["parquet", "mp4"],
    takes=RENDERS,
    shared=ConcurrentBuild(_film, _seconds_of_filming),
    wants=lambda study, key: bool({*study.arms} & {*arms_of_category(str(key))}),
    lost=_lost_arms,
)
def arms(workspace: Workspace, category: str) -> StageOutput:
    """Return a category's clips and questions beside the pairs, one row each: arms and variations."""
    from traps_pipeline.benchmark.filmed_arms import build_arms

    rows = build_arms(workspace, category)
    n_admitted = sum(row.refused is None for row in rows)
    return StageOutput(rows, shown={"admitted": n_admitted, "refused": len(rows) - n_admitted})


def _odd_pairs(workspace: Workspace, key: str | None, output: StageOutput) -> dict[str, list[str]]:
    from traps_pipeline.benchmark.held_out import held_out_items

    sides, alone = dict[str, list[str]](), held_out_items(workspace.root)
    for row in output.rows(ITEMS):
        if row.scenario_id in alone:
            continue
        sides.setdefault(row.pair_id, []).append(row.side)
    return {pair: pair_sides for pair, pair_sides in sides.items() if tuple(sorted(pair_sides)) != sides_of(str(key))}


@_stage(
    ITEMS,
    parents=[
        dep(scene_specs, category_to_datasets),
        dep(videos, category_to_datasets),
        *([dep(arms, category_to_arms)] if is_declared("arms") else []),
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
            lambda workspace, key, output: sorted(
                (named := {row.clip for row in output.rows(ITEMS)}) - workspace.sizes(named).keys()
            ),
        ),
    ],
)
def items(workspace: Workspace, dataset: str) -> StageOutput:
    """Return a dataset's questions that models are asked, one row each: on the control and on the void of a pair."""
    from traps_pipeline.benchmark.items import build_items

    rows = build_items(workspace, dataset)
    return StageOutput(
        rows, shown={"benchmark version": rows[0].benchmark_version if rows else "none: no item of it was released"}
    )
