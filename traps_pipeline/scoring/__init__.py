"""Score the panel's verdicts: metrics with intervals (docs/spec.md 5)."""
