"""What is kept on disk: the workspace, its Parquet tables, its ledger of paid calls."""
