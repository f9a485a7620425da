"""Who judges: the panel, what it is shown, how its votes become a verdict (`benchmark.md` section 4)."""
