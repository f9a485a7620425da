"""TRAPSBench: do vision-language models know when not to answer? One Dagster DAG from scene specs to a leaderboard."""
