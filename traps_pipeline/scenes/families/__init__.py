"""Define scene families, one per file; docs/scenes.md says how to add one."""
