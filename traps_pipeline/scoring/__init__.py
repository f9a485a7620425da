"""From the panel's verdicts to figures with intervals (benchmark.md section 5)."""
