"""Build the explorer: pages to browse a study's answers, opened from disk."""
