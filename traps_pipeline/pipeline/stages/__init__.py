"""Declare the stages on import, one file per group, without Dagster.

A stage reads tables, calls a library function and returns the rows of its table.
"""

from traps_pipeline.pipeline.schemes import LEFT_OUT
from traps_pipeline.pipeline.stages import benchmark_stages, evaluation_stages

if "mechanism" not in LEFT_OUT:  # before the report, which reads its tables
    from traps_pipeline.pipeline.stages import inside_stages, mechanism_stages  # noqa: F401

from traps_pipeline.pipeline.stages import judging_stages, people_stages, report_stages, scoring_stages

__all__ = [
    "benchmark_stages",
    "evaluation_stages",
    "judging_stages",
    "people_stages",
    "report_stages",
    "scoring_stages",
]
