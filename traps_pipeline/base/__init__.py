"""Shared helpers below every other room: errors, files, digests, paths, keys and terminal output."""
