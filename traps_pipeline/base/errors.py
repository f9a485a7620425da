"""Define the exception that the command line prints without a traceback."""

from traps_pipeline.base.redaction import redact


class TrapsError(Exception):
    """Bad input or a broken file; names file, record and remedy, and holds no key."""

    def __init__(self, message: object) -> None:
        super().__init__(redact(str(message)))
