"""Look inside local models: states, probes, steering (docs/spec.md 7 and 8)."""
