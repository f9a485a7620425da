"""The option `--quick` of every benchmark: a small size, by which the campaign sees that the script still runs."""

from __future__ import annotations

import argparse
from typing import Any


def parse(parser: argparse.ArgumentParser, **quick: Any) -> argparse.Namespace:
    """Parse the command line; with `--quick` these values stand for options that are not given."""
    parser.add_argument("--quick", action="store_true", help="a small size, to see that it runs")
    arguments = parser.parse_args()
    if arguments.quick:
        parser.set_defaults(**quick)
        arguments = parser.parse_args()
    return arguments
