"""Hold the benchmark as data: released records, corrections, versions and items."""
