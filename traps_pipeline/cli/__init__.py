"""Build the `traps` command; each other file defines one group of commands."""

import argparse
import atexit
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import missing_extra_sentence
from traps_pipeline.base.files import remedy
from traps_pipeline.base.redaction import redact_tracebacks
from traps_pipeline.base.terminal import plain
from traps_pipeline.cli import (
    benchmark_commands,
    completion_commands,
    doctor_commands,
    exchange_commands,
    init_commands,
    ledger_commands,
    models_commands,
    people_commands,
    plan_commands,
    publish_commands,
    results_commands,
    run_commands,
    status_commands,
    ui_commands,
)
from traps_pipeline.cli.command import FAILED, INTERRUPTED, OK, SHORT_NAMES, Commands, Parser, Run, print_failure

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GROUPS = {
    "study": "plan, run and look after a study",
    "results": "explore, export and compare results",
    "benchmark": "sample, certify and commit to a benchmark",
    "models": "check models, judges and panels",
    "people": "review scenarios, label clips and answers",
    "publish": "write and verify releases and submissions",
}
START = """TRAPSBench: do vision-language models know when not to answer?

  traps doctor                  check this machine
  traps run demo                evaluate reference strategies; needs no key
  traps plan mine.yaml          count calls and dollars; nothing is sent
  traps status                  say what is not fresh, and how to mend it
  traps why ITEM                show an item with its answers and votes
  traps site                    write the explorer of all answers and clips

{groups}

A group lists its commands, and `--help` behind a command shows an example.
`traps completion bash` prints what a shell needs to complete them."""


def main(argv: Sequence[str] | None = None, parser: argparse.ArgumentParser | None = None) -> int:
    """Run a subcommand and return its exit code.

    0: done, 1: failed, 2: bad usage, 4: over budget, 130: interrupted. parser: replaces the default one.
    """
    gc.set_threshold(1_000_000, 20, 20)  # no collections while a command imports, which saves half a second
    atexit.register(gc.freeze)  # the interpreter's last collections would visit every object, which takes a second
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # looking for some reads every installed distribution
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path or a word that this terminal cannot show
    redact_tracebacks()
    try:
        return _run(argv, parser or build_parser())
    except BrokenPipeError:
        # The reader has gone (`| head`); the interpreter's last flush must not report that either.
        for stream in (sys.stdout, sys.stderr):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return INTERRUPTED


def _run(argv: Sequence[str] | None, parser: argparse.ArgumentParser) -> int:
    """Run a subcommand. Raises BrokenPipeError if the reader of its output has gone."""
    as_json = False
    try:
        arguments = parser.parse_args(argv)
        as_json = getattr(arguments, "progress", None) == "json"
        command: Run = arguments.command
        with _stop_on_signals():
            return command(arguments)
    except BrokenPipeError:
        raise
    except TrapsError as error:
        print_failure(str(error), as_json=as_json)
        return FAILED
    except ModuleNotFoundError as error:
        if (sentence := missing_extra_sentence(error)) is None:
            raise
        print_failure(sentence, as_json=as_json)
        return FAILED
    except OSError as error:
        location = f"{plain(error.filename)[:200]}: " if error.filename else ""
        failure = f"{location}{error.strerror}; {remedy(error)} and run the same command again"
        print_failure(failure, as_json=as_json)
        return FAILED
    except KeyboardInterrupt:
        print(end="" if as_json else "\n", file=sys.stderr)
        failure = "interrupted; every finished answer and clip is kept. Run the same command to continue."
        print_failure(failure, as_json=as_json)
        return INTERRUPTED
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()


def _open_closed_streams() -> None:
    """Open what the shell closed (`>&-`) on the null device: a ledger must never get the number of an output."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))


@contextmanager
def _stop_on_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP act like Ctrl-C within the block.

    A shell starts `command &` of a script with SIGINT ignored, and then SIGTERM would do nothing either; both are
    handled again here. An ignored SIGHUP stays ignored, which is the meaning of `nohup`.
    """
    previous_handlers = {}
    for signal_number in STOPS if threading.current_thread() is threading.main_thread() else ():
        handler = signal.getsignal(signal_number)
        if handler == signal.SIG_DFL or (handler == signal.SIG_IGN and signal_number != signal.SIGHUP):
            interrupt = signal.default_int_handler if signal_number == signal.SIGINT else _raise_interrupt
            previous_handlers[signal_number] = signal.signal(signal_number, interrupt)
    try:
        yield
    finally:
        for signal_number, handler in previous_handlers.items():
            signal.signal(signal_number, handler)


def _raise_interrupt(*_: object) -> None:
    signal.raise_signal(signal.SIGINT)


@cache
def build_parser() -> Parser:
    """Return the parser of the command line, which is built once and changed by nothing."""
    parser = Parser(
        prog="traps",
        description="TRAPSBench: do vision-language models know when not to answer?",
        epilog=f"without their group: traps {', '.join(SHORT_NAMES)}",
        short=SHORT_NAMES,
    )
    parser.set_defaults(command=_show_start, parser=parser)
    parser.add_argument(
        "--version", dest="command", action="store_const", const=_show_version, help="print the version"
    )
    commands = Commands(parser, GROUPS)
    for module in (
        doctor_commands,
        init_commands,
        plan_commands,
        run_commands,
        status_commands,
        ui_commands,
        exchange_commands,
        ledger_commands,
        results_commands,
        benchmark_commands,
        models_commands,
        people_commands,
        publish_commands,
        completion_commands,
    ):
        module.add(commands)
    return parser


def _show_start(_: argparse.Namespace) -> int:
    print(START.format(groups="\n".join(f"  traps {name:<24}{text}" for name, text in GROUPS.items())))
    return OK


def _show_version(_: argparse.Namespace) -> int:
    from importlib.metadata import version

    print(f"traps {version('traps-pipeline')}")
    return OK
