"""Publish a study.

The released folder, commitments, harnesses, results files and submissions.
"""
