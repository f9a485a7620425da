"""Serve local web pages: the review of scenarios, and labels by people."""
