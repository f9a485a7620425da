"""The page of all commands, docs/commands.md, written from the parser.

`python -m tests.commands_page` writes it; a test holds the page against it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from tests.conftest import ROOT
from traps_pipeline.cli import GROUPS, build_parser
from traps_pipeline.cli.command import SHORT, Parser

PAGE = ROOT / "docs" / "commands.md"
HEAD = """# Commands

For everyone who types `traps`. After this page you know every command and option. `--help` behind a command shows the
same; `python -m tests.commands_page` writes this page from the parser.

Most commands work in a study: `--workspace` names its folder or s3:// address (default: `$TRAPS_WORKSPACE`, else
`.workspaces/default`). Commands that print data print JSON with `--json`; progress and errors go to standard error.
[Headless use](ci.md#exit-codes) lists the exit codes. The commands {short}
need no group: `traps run` is `traps study run`.
`eval "$(traps completion bash)"` lets a shell complete commands, options and experiments (`zsh` in its place for zsh).
"""
EVERYWHERE = ("help", "workspace", "json")


def page() -> str:
    """Return the page."""
    parser = build_parser()
    short = ", ".join(f"`{name}`" for name in SHORT)
    parts = [HEAD.format(short=short)]
    for group, text in [*GROUPS.items(), ("", "")]:
        own = {path: each for path, each in parser.commands.items() if path.rpartition(" ")[0] == group}
        parts += [f"## {group.capitalize() or 'Shell'}\n", *([f"To {text}.\n"] if text else [])]
        parts += [_section(path, each) for path, each in own.items()]
    return "\n".join(parts)


def _section(path: str, parser: Parser) -> str:
    (example,) = (line for line in (parser.epilog or "").splitlines() if line.startswith("example: "))
    has_json = " `--json` prints the result as JSON." if "--json" in parser.options() else ""
    text = f"{parser.description}".rstrip(".")
    about = f"{text[0].upper()}{text[1:]}.{has_json}"
    lines = [f"### traps {path}\n", f"{about}\n\nExample: `{example[9:].strip()}`\n"]
    rows = [*_rows(parser)]
    return "\n".join([*lines, *(["| argument | meaning |", "| --- | --- |", *rows, ""] if rows else [])])


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
        yield f"| `{name}`{must} | {meaning.replace('|', chr(92) + '|')} |"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
