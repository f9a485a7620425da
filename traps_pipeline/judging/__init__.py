"""The panel of judges: what judges are asked, and how their votes become verdicts (docs/spec.md 4)."""
