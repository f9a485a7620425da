"""Tabulate the `Results` of a study or of the paper (docs/spec.md 10)."""
