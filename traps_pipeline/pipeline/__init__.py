"""The pipeline: how a stage is declared and made, which partitions a study wants, what is stale, who makes it anew."""
