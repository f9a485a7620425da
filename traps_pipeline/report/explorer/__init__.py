"""Build the explorer, pages to browse a study's answers.

Its folder opens from disk.
"""
