"""The explorer: pages to browse a study's answers, in a folder that opens from disk."""
