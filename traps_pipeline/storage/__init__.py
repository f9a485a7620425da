"""What is kept on disk: a workspace, what its `study.yaml` says, its tables, its ledger of paid calls, prepared media."""
