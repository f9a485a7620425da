"""Declare stages, compute which partitions are wanted or stale, and build them."""
