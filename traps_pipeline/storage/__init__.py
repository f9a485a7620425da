"""What is kept on disk: the workspace and its `study.yaml`, its Parquet tables, its ledger of paid calls, the media sent."""
