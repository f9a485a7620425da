"""One file a scene family; the file's name is the family's. See docs/scenes.md for how to add one."""
