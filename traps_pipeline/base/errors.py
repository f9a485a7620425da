"""The one exception that the command line shows as a sentence instead of a traceback."""

from __future__ import annotations


class TrapsError(Exception):
    """Bad input or a broken file: the message names the file and the record, and says what to do."""
