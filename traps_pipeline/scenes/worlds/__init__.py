"""Scenarios as data and as simulated worlds: outcome, length, and clips."""
