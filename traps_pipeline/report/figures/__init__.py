"""Draw the figures of docs/spec.md 10, from any `Results`.

Equal frames give equal bytes.
"""
