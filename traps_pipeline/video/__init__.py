"""Encode clips, and choose which of their frames a model is shown."""
