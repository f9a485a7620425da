"""The rows of verdicts that the tests of scores are worked out from."""

from tests.scoring.conftest import rows

__all__ = ["rows"]
