"""The tables of docs/spec.md 10, from any `Results`: a study's or the paper's."""
