"""Checks before money is spent: the machine, the requests as bytes, the live endpoint."""
