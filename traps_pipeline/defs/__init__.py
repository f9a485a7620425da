"""The DAG: one file per group of stages; importing this package declares all of them, without Dagster.

A stage reads tables, calls a library function and returns the rows of its table.
"""

from traps_pipeline.defs import benchmark, evaluation, inside, judging, mechanism, people, report, scoring

__all__ = ["benchmark", "evaluation", "inside", "judging", "mechanism", "people", "report", "scoring"]
