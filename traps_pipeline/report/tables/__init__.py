"""The tables of benchmark.md section 10, from any `Results`: a study's or the paper's."""
