"""The code location: `dagster ... -m traps_pipeline.definitions`."""

from __future__ import annotations

import dagster as dg

from traps_pipeline.defs import benchmark, evaluation, report, scoring
from traps_pipeline.defs.common import watch_sources
from traps_pipeline.paths import require_checkout

require_checkout()

SOURCES = [benchmark.released_specs, benchmark.corrections, evaluation.models, evaluation.prompts, evaluation.judges]
ASSETS = [
    benchmark.scene_specs,
    benchmark.videos,
    benchmark.items,
    evaluation.responses,
    evaluation.votes,
    evaluation.verdicts,
    scoring.metrics,
    scoring.leaderboard,
    report.pecs_landscape,
    report.contact_sheet,
    report.leaderboard_page,
]
JOBS = [
    dg.define_asset_job(
        "render", dg.AssetSelection.assets("scene_specs", "videos"), description="Specs and clips of a category."
    ),
    dg.define_asset_job(
        "evaluate",
        dg.AssetSelection.assets("responses", "votes", "verdicts"),
        description="Answers, votes and verdicts of cells.",
    ),
    dg.define_asset_job(
        "publish",
        dg.AssetSelection.assets("leaderboard", "pecs_landscape", "contact_sheet", "leaderboard_page"),
        description="The leaderboard and its pages, from the metrics that are there.",
    ),
]

# In process: a run costs 2 s instead of 5, and rendering and asking bring their own processes and connections.
defs = dg.Definitions(
    assets=[*SOURCES, *ASSETS],
    sensors=[watch_sources],
    asset_checks=report.inputs_current,
    jobs=JOBS,
    executor=dg.in_process_executor,
)
