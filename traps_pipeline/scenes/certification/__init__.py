"""Certify pairs: evidence, thresholds, and ensembles of possible futures."""
