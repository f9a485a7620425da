"""The figures of benchmark.md section 10, from any `Results`; the same frames give the same bytes."""
