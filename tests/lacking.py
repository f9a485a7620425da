"""What a test does where a program or a package that it needs is not installed."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import NoReturn

import pytest

ALL = "TRAPS_TEST_ALL"  # set by `make test`, which installs everything: there nothing may be left out unseen


def lack(what: str) -> NoReturn:
    """Skip the test, or fail it where nothing may lack."""
    if os.environ.get(ALL):
        pytest.fail(f"{what} (and {ALL} is set: nothing may lack)", pytrace=False)
    pytest.skip(what)


def need(*modules: str, what: str) -> None:
    """Skip or fail the test unless all modules are installed."""
    if not all(map(find_spec, modules)):
        lack(what)
