"""Represent scenarios as records and as simulated worlds, and render their clips."""
