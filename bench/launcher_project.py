"""The Dagster project of `bench/cluster_launcher.py`: cells that each take half a minute of small steps, every step a
row in PostgreSQL that is written once, as the ledger's are."""

import os
import time

import dagster as dg
import psycopg

CELLS, STEPS, STEP_S = [f"c{n:02d}" for n in range(12)], 60, 0.5
VARIABLE = "TRAPS_LAUNCHER_DATABASE"
SCHEMA = """
create table if not exists tried (cell text, step int, run text, node text, at timestamptz default clock_timestamp());
create table if not exists made (cell text, step int, node text, primary key (cell, step));
"""


@dg.asset(partitions_def=dg.StaticPartitionsDefinition(CELLS))
def work(context: dg.AssetExecutionContext) -> None:
    """A cell: the steps that no run before this one has made."""
    cell, node = context.partition_key, os.environ.get("TRAPS_NODE", "none")
    with psycopg.connect(os.environ[VARIABLE], autocommit=True) as database:
        known = {step for (step,) in database.execute("select step from made where cell = %s", [cell])}
        for step in sorted({*range(STEPS)} - known):
            database.execute("insert into tried values (%s, %s, %s, %s)", [cell, step, context.run_id, node])
            time.sleep(STEP_S)
            database.execute("insert into made values (%s, %s, %s) on conflict do nothing", [cell, step, node])


# In process, as this project's runs are: a step in a process of its own outlives the kill of its run.
defs = dg.Definitions(assets=[work], jobs=[dg.define_asset_job("launcher", [work])], executor=dg.in_process_executor)
