"""Scene families, one a file of the same name; docs/scenes.md says how to add one."""
