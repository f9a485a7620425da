"""From the panel's verdicts to figures with intervals (docs/spec.md 5)."""
