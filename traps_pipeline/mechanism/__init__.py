"""Look inside local models.

Hidden states, probes, void directions, steering (docs/spec.md 7 and 8).
"""
