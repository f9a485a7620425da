"""Declare models, judges, panels, accounts and prompts."""
