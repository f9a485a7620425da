"""The figures of docs/spec.md 10, from any `Results`; the same frames give the same bytes."""
