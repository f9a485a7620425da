"""Ask the panel of judges, and turn their votes into verdicts (docs/spec.md 4)."""
