"""What is kept on disk: a workspace and its `study.yaml`, its tables, its ledger of paid calls, its prepared media."""
