"""Define the exception that the command line shows as a sentence.

Any other is shown as a traceback.
"""

from __future__ import annotations

from traps_pipeline.base.redaction import redact


class TrapsError(Exception):
    """Bad input or a broken file.

    The message names file and record, says what to do, and holds no key.
    """

    def __init__(self, message: object) -> None:
        super().__init__(redact(str(message)))
