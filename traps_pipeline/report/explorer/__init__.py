"""Pages on which people look at a study's answers: the explorer, a folder that opens from disk."""
