"""Inside local models: hidden states, probes, void directions, steering (docs/spec.md 7 and 8)."""
