"""Plot the figures of docs/spec.md 10; equal frames give equal bytes."""
