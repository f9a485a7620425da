"""How a test carries a remedy out: a call is refused, what the error says is done, and the same call succeeds.

The error is known by the function that raises it, not by its words: they may be improved without breaking a test."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

from tests.build.errors import raises
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.cli import build_parser
from traps_pipeline.storage.workspace import VARIABLE

T = TypeVar("T")


def refused(call: Callable[[], T], by: str, *, error: type[BaseException] = TrapsError) -> Callable[[], T]:
    """Return `call` after it ended in `error`, raised in the function or module `by`; any of the package if empty."""
    with raises(error, by):
        call()
    return call


def remedied(
    call: Callable[[], T],
    by: str,
    remedy: Callable[[], object] | None = None,
    *,
    again: Callable[[], T] | None = None,
    error: type[BaseException] = TrapsError,
) -> T:
    """Return what `call` gives once `remedy` is carried out; before, `by` refuses it with `error`.

    again: the call with what the error says to give instead, where the remedy is another argument.
    """
    assert (remedy is None) != (again is None), (
        "a remedy is either done before the same call, or another argument of it"
    )
    refused(call, by, error=error)
    if remedy is not None:
        remedy()
    return (again or call)()


def command(*arguments: object) -> None:
    """Run a `traps` command in this process. Raises its error, or TrapsError where it ends in another code than 0."""
    before, parsed = os.environ.get(VARIABLE), build_parser().parse_args([str(argument) for argument in arguments])
    try:
        code = parsed.command(parsed)
    finally:  # a command tells the processes that it starts where its workspace is
        if before is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = before
    if code:
        raise TrapsError(f"the command ended with {code}")
