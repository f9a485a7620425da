"""How a test carries a remedy out: the real thing is refused with the sentence, what the sentence says is done, and the
same call succeeds. `test_every_remedy.py` reads the sentences of these calls, so that each remedy of the package has a
test that carries it out."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Callable
from typing import TypeVar

import pytest

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import main
from traps_pipeline.storage.workspace import VARIABLE

T = TypeVar("T")


def says(sentence: str, told: str) -> bool:
    """Whether an error has a part of a sentence of the package; `{}` stands for what is only known then."""
    sentence = sentence.rpartition(" | ")[2]
    return re.search(re.escape(sentence).replace(r"\{\}", ".*?"), told, re.DOTALL) is not None


def refused(call: Callable[[], T], sentence: str, *, error: type[BaseException] = TrapsError) -> Callable[[], T]:
    """`call`, after it ended in `error` with `sentence`: to be made again when the remedy of several is carried out."""
    with pytest.raises(error) as caught:
        call()
    assert says(sentence, str(caught.value)), f"{sentence}\nis not what was said: {caught.value}"
    return call


def remedied(
    call: Callable[[], T],
    sentence: str,
    remedy: Callable[[], object] | None = None,
    *,
    again: Callable[[], T] | None = None,
    error: type[BaseException] = TrapsError,
) -> T:
    """What `call` returns once `remedy` is carried out; before, it ends in `error` with `sentence`.

    again: the call with what the sentence says to give instead, where the remedy is another argument.
    """
    assert (remedy is None) != (again is None), (
        "a remedy is either done before the same call, or another argument of it"
    )
    refused(call, sentence, error=error)
    if remedy is not None:
        remedy()
    return (again or call)()


def carries_out(*sentences: str) -> Callable[[T], T]:
    """Marks a test that provokes errors with these sentences, carries out what they say and sees the command succeed,
    where `remedied` does not fit: a command in a process of its own, or several errors at once."""
    assert sentences

    def marked(test: T) -> T:
        return test

    return marked


def command(*arguments: object) -> None:
    """Run a `traps` command in this process. Raises TrapsError with what it says on stderr unless it ends in 0."""
    said, before = io.StringIO(), os.environ.get(VARIABLE)
    try:
        with contextlib.redirect_stderr(said):
            code = main([str(argument) for argument in arguments])
    finally:  # a command tells the processes that it starts where its workspace is
        if before is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = before
    if code:
        raise TrapsError(said.getvalue())
