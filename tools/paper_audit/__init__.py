"""Recompute the statements of the paper from the tables that it prints."""
