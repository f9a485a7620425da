"""Share errors, files, digests, paths, keys and terminal output with all rooms."""
