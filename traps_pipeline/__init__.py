"""Measure whether vision-language models know when not to answer (TRAPSBench).

One Dagster DAG leads from scene specs to a leaderboard.
"""
