"""The pipeline: declare stages, compute which partitions a study wants and which are stale, and materialize them."""
