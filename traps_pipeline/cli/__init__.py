"""The `traps` command: its parser and exit codes. Each other file here has one noun and its commands' arguments."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Sequence

from traps_pipeline.cli import (
    benchmark,
    confabulation,
    doctor,
    exchange,
    init,
    judges,
    models,
    plan,
    pocket,
    results,
    run,
    status,
)
from traps_pipeline.cli.command import FAILED, INTERRUPTED, Commands, Run
from traps_pipeline.errors import TrapsError


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand; returns the exit code: 0 done, 1 something failed, 2 bad usage, 4 a budget is reached, 130
    interrupted."""
    gc.set_threshold(50_000, 20, 20)  # imported objects stay: searching them for garbage costs half a second
    arguments = build_parser().parse_args(argv)
    command: Run = arguments.command
    try:
        return command(arguments)
    except TrapsError as error:
        print(f"traps: {error}", file=sys.stderr)
        return FAILED
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            sys.stderr.close()
        else:
            where = f"{error.filename}: " if error.filename else ""
            print(f"traps: {where}{error.strerror}; correct this and run the same command again", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(
            "\ntraps: interrupted; every finished answer and clip is kept. Run the same command to continue.",
            file=sys.stderr,
        )
        return INTERRUPTED


def build_parser() -> argparse.ArgumentParser:
    """The command line; `traps --help` lists the commands in this order."""
    parser = argparse.ArgumentParser(
        prog="traps", description="TRAPSBench: do vision-language models know when not to answer?"
    )
    commands = Commands(parser, title="commands")
    for noun in (doctor, init, plan, run, status, results, exchange, models, judges, confabulation, benchmark, pocket):
        noun.add(commands)
    return parser
