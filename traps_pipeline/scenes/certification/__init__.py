"""Certificates of a pair: the evidence, its thresholds, and the ensembles of possible futures."""
