"""Run transformers checkpoints on this machine; nothing is imported at start, since torch takes seconds."""
