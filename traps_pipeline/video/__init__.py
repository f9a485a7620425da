"""Encoding of clips, and which of their frames a model is shown."""
