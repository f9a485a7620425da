"""Batches of requests, and answers from elsewhere."""
