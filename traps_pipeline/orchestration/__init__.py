"""The graph of stages as Dagster runs it: how a stage is declared and made, what is stale, who makes it anew."""
