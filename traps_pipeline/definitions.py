"""The code location: `dagster ... -m traps_pipeline.definitions`."""

from __future__ import annotations

import dagster as dg

from traps_pipeline.defs import benchmark, evaluation, judging, mechanism, report, scoring
from traps_pipeline.defs.common import observe_sources, recorded_versions, watch_sources
from traps_pipeline.defs.report import inputs_current
from traps_pipeline.paths import require_checkout

require_checkout()

SOURCES = [
    benchmark.released_specs,
    benchmark.corrections,
    evaluation.models,
    evaluation.prompts,
    evaluation.judges,
    judging.confabulation_protocol,
    judging.judge_validation,
    report.published,
    *mechanism.SOURCES,
]
ASSETS = [
    benchmark.scene_specs,
    benchmark.videos,
    benchmark.items,
    evaluation.responses,
    evaluation.votes,
    evaluation.verdicts,
    scoring.metrics,
    scoring.contrasts,
    scoring.regime_tests,
    scoring.leaderboard,
    *judging.ASSETS,
    *mechanism.ASSETS,
    *report.ASSETS,
]
# In process: a run costs 2 s instead of 5, and rendering and asking bring their own processes and connections.
defs = dg.Definitions(
    assets=[*SOURCES, *ASSETS],
    sensors=[watch_sources],
    asset_checks=[inputs_current],
    executor=dg.in_process_executor,
)

__all__ = ["ASSETS", "SOURCES", "defs", "inputs_current", "observe_sources", "recorded_versions"]
