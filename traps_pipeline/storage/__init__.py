"""Store a study: workspace, `study.yaml`, tables, ledger and prepared media."""
