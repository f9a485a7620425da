"""Define the benchmark's vocabulary and keys.

Datasets, arms, regimes, metrics and the cells that they span.
"""
