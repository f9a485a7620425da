"""`traps` in the process of the test: what most tests want to see is what a command prints and leaves, not a process.

Tests that kill, stop, trace or limit a command start one (`Checkout.start`), and so does `Checkout.traps` where the
checkout is a copy whose code or data a test may change.
"""

from __future__ import annotations

import io
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from types import ModuleType

import pytest

from tests.build.errors import raised_in

PACKAGE = "traps_pipeline"
# The graph is declared for the study that the environment names when it is imported: these rooms stand on it.
OF_ONE_STUDY = ("cli", "cluster", "definitions", "exchange", "pipeline", "release", "servers")


def traps(arguments: Sequence[str], folder: Path, environment: Mapping[str, str]) -> tuple[int, str, str, str]:
    """Run a `traps` command in a folder with exactly this environment.

    Returns its exit code, stdout, stderr, and the function whose error ended it (`tests.build.errors.raised_in`).
    """
    out, err, raised = _Stream(), _Stream(), ""
    with _surroundings(folder, environment), redirect_stdout(out), redirect_stderr(err):
        from traps_pipeline import cli

        def print_failure(*sentence: str, as_json: bool = False) -> None:
            nonlocal raised
            raised = raised_in(error) if (error := sys.exception()) else ""
            printed(*sentence, as_json=as_json)

        printed, cli.print_failure = cli.print_failure, print_failure
        try:
            code = cli.main(arguments)
        except SystemExit as end:  # argparse: bad usage, or --help
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            cli.print_failure = printed
    return code, out.text(), err.text(), raised


@contextmanager
def _surroundings(folder: Path, environment: Mapping[str, str]) -> Iterator[None]:
    """Let a command find what a process of its own has, and forget what it left in this one."""
    variables, graph = dict(os.environ), _modules_taken_out()
    factory, hook = logging.getLogRecordFactory(), sys.excepthook
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        try:
            _export(environment)
            yield
        finally:
            _export(variables)
            logging.setLogRecordFactory(factory)
            sys.excepthook = hook
            _modules_taken_out()
            sys.modules.update(graph)
            for name, module in graph.items():
                package, _, last = name.rpartition(".")
                setattr(sys.modules[package], last, module)


def _export(environment: Mapping[str, str]) -> None:
    for name in {*os.environ} - {*environment}:
        del os.environ[name]
    os.environ.update(environment)


def _modules_taken_out() -> dict[str, ModuleType]:
    """Take the modules of the rooms of one study out of those that are imported."""
    rooms = {f"{PACKAGE}.{room}" for room in OF_ONE_STUDY}
    names = [name for name in sys.modules if ".".join(name.split(".")[:2]) in rooms]
    return {name: sys.modules.pop(name) for name in names}


class _Stream(io.TextIOWrapper):
    """A stream that keeps what is written to it, as a pipe would carry it."""

    def __init__(self) -> None:
        self._bytes = io.BytesIO()
        super().__init__(self._bytes, encoding="utf-8", write_through=True)

    def text(self) -> str:
        """Return what was written, with the line ends of a pipe in text mode."""
        return self._bytes.getvalue().decode().replace("\r\n", "\n").replace("\r", "\n")
