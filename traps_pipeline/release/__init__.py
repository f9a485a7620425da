"""Publish a study: release folder, commitments, harnesses, results, submissions."""
