"""The vocabulary and keys of the benchmark: datasets, arms, regimes, metrics and the cells that they span."""
