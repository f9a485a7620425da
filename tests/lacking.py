"""What a test does where a program or a package that it needs is not installed.

It is skipped by name; `make test` and `make campaign` fail on it (`tests/tiers.py`).
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import NoReturn

import pytest


def lack(what: str) -> NoReturn:
    """Skip the test."""
    pytest.skip(what)


def need(*modules: str, what: str) -> None:
    """Skip the test unless all modules are installed."""
    if not all(map(find_spec, modules)):
        lack(what)
