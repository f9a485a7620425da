"""The tables of docs/spec.md 10, from the `Results` of a study or of the paper."""
