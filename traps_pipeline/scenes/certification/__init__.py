"""Certificates of a pair: evidence, thresholds, and ensembles of possible futures."""
