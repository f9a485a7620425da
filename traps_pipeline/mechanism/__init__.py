"""Inside local models: hidden states, probes, void directions, steering (`benchmark.md` sections 7 and 8)."""
