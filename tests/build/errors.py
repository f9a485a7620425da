"""Errors, known by what raises them and by what they name, never by the words of their sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

import pytest
from pydantic import ValidationError

PACKAGE = "traps_pipeline."
OURS = (PACKAGE, "traps_cluster.", "tools.")


def raised_in(error: BaseException) -> str:
    """Return the innermost function of the package in a traceback, as `base.files.replace_file`, or of `tools`.

    Otherwise the model of pydantic that refused, or nothing.
    """
    function, frames = "", error.__traceback__
    while isinstance(frames, TracebackType):
        module = frames.tb_frame.f_globals.get("__name__", "")
        if module.startswith(OURS):
            function = f"{module.removeprefix(PACKAGE)}.{frames.tb_frame.f_code.co_qualname}"
        frames = frames.tb_next
    return error.title if not function and isinstance(error, ValidationError) else function


@contextmanager
def raises(error: type[BaseException], by: str = "", *names: str) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """Expect an error that a function, class or module of the package raises, as `base.files.replace_file`.

    by: any of the package if empty; of pydantic's errors the model. names: values of the test that the sentence must
    repeat, such as a file, a line or a model: a user finds the input by them.
    """
    with pytest.raises(error) as caught:
        yield caught
    function = raised_in(caught.value)
    assert not by or f"{function}.".startswith(f"{by}."), f"raised in {function}, not {by}: {caught.value}"
    for name in names:
        assert name in str(caught.value), f"{name} is not named: {caught.value}"
