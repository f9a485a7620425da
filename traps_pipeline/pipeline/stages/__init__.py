"""The DAG: one file per group of stages; importing this package declares all that the study uses, without Dagster.

A stage reads tables, calls a library function and returns the rows of its table. It imports that function where it
calls it: `traps status` imports the declarations alone.
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
