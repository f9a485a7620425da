"""Everything that only several hosts need: runs on Ray, a study in an object store, shared history and logs."""
