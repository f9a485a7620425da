"""The figures of docs/spec.md 10, from any `Results`; equal frames give equal bytes."""
