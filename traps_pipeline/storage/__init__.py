"""A study on disk: its workspace and `study.yaml`, tables, ledger of paid calls, and prepared media."""
