"""Define the vocabulary and keys: datasets, arms, regimes, metrics and cells."""
