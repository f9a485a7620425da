"""Declare the stages on import, one file per group, without Dagster.

A stage reads tables, calls a library function and returns the rows of its table.
"""

from traps_pipeline.pipeline.stages import (
    benchmark_stages,
    evaluation_stages,
    inside_stages,
    judging_stages,
    mechanism_stages,
    people_stages,
    report_stages,
    scoring_stages,
)

__all__ = [
    "benchmark_stages",
    "evaluation_stages",
    "inside_stages",
    "judging_stages",
    "mechanism_stages",
    "people_stages",
    "report_stages",
    "scoring_stages",
]
