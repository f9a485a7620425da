"""The page of all commands, docs/commands.md, written from the parser.

`python -m tools.commands_page` writes it; a test holds the page against it.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from traps_pipeline.cli import GROUPS, build_parser
from traps_pipeline.cli.command import SHORT_NAMES, Parser

PAGE = Path(__file__).parents[1] / "docs" / "commands.md"
HEAD = """# Commands

For everyone who types `traps`: every command and option. `--help` shows the same, with an example; `python -m
tools.commands_page` writes this page from the parser.

- `--workspace` names the study's folder or s3:// address (default: `$TRAPS_WORKSPACE`, else `.workspaces/default`).
- Results go to standard output, progress and errors to standard error, [exit codes](ci.md#exit-codes) to scripts.
- {short} need no group: `traps run` is `traps study run`.
- `eval "$(traps completion bash)"` lets bash complete commands, options and experiments; for zsh write `zsh`.

## Common arguments

They mean this unless a command says otherwise.

{common}
"""
EVERYWHERE = ("help", "workspace")
COMMANDS_OF_A_COMMON_ARGUMENT = 3


def page() -> str:
    """Return the page."""
    parser = build_parser()
    counts = Counter(row for command in parser.commands.values() for row in _rows(command))
    common = {row: None for row, count in counts.items() if count >= COMMANDS_OF_A_COMMON_ARGUMENT}
    short = ", ".join(f"`{name}`" for name in SHORT_NAMES)
    parts = [HEAD.format(short=short, common="\n".join(common))]
    for group in (*GROUPS, ""):
        own = {path: each for path, each in parser.commands.items() if path.rpartition(" ")[0] == group}
        parts += [f"## {group.capitalize() or 'Shell'}\n", *(_section(*each, {*common}) for each in own.items())]
    return "\n".join(parts)


def _section(path: str, parser: Parser, common: set[str]) -> str:
    text = f"{parser.description}".rstrip(".")
    rows = [*_rows(parser)]
    shared = ", ".join(row.split("`")[1].split(" ")[0] for row in rows if row in common)
    also = f" Also `{shared.replace(', ', '`, `')}`." if shared else ""
    lines = [f"### traps {path}\n", f"{text[0].upper()}{text[1:]}.{also}\n"]
    own = [row for row in rows if row not in common]
    return "\n".join([*lines, *([*own, ""] if own else [])])


def _rows(parser: Parser) -> Iterator[str]:
    for action in parser._actions:
        if action.dest in EVERYWHERE:
            continue
        choices = ", ".join(map(str, action.choices)) if action.choices else ""
        metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper().replace("_", "-")
        takes = "" if isinstance(action, argparse._StoreTrueAction) or action.nargs == 0 else metavar
        name = f"{action.option_strings[0]} {takes}".strip() if action.option_strings else takes
        text = action.help or ""
        meaning = "; ".join(
            part for part in (text, f"one of {choices}" if choices and choices not in text else "") if part
        )
        must = " (required)" if action.required and action.option_strings else ""
        yield f"- `{name}`{must}: {meaning}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
