"""Who judges: the panel, what it is shown, how its votes become a verdict (docs/spec.md 4)."""
