"""Store a study on disk.

Its workspace and `study.yaml`, tables, ledger of paid calls, and prepared media.
"""
