"""The panel of judges: what it is shown, and how its votes become verdicts (docs/spec.md 4)."""
