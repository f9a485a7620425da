"""`traps site`: the explorer of a study, a folder that opens from disk."""

from __future__ import annotations

import argparse
from pathlib import Path

from traps_pipeline.cli.command import OK, Commands, open_workspace


def add(commands: Commands) -> None:
    """Add `traps site`."""
    text = "write a folder to explore all answers and clips in; it opens from disk"
    parser = commands.add("results site", site, text, example="site --without-clips")
    parser.add_argument("folder", nargs="?", type=Path, help="default: `site` in the study's folder")
    parser.add_argument("--without-clips", action="store_true", help="leave the clips out, for a small folder")


def site(arguments: argparse.Namespace) -> int:
    """See `traps site --help`."""
    from traps_pipeline.report.explorer.site import INDEX, write_site

    workspace = open_workspace(arguments)
    folder = (arguments.folder or workspace.root / "site").absolute()
    written = write_site(workspace, folder, clips=not arguments.without_clips)
    clips = f"{written.clips} clips, {_megabytes(written.clip_bytes)}"
    print(
        f"{written.answers} answers with {written.votes} votes: {written.files} files, {_megabytes(written.bytes)}; "
        + ("without clips" if arguments.without_clips else clips)
    )
    if written.lacking:
        print(f"{len(written.lacking)} clips are not in the study, the first is {written.lacking[0]}")
    print(f"next: open {folder / INDEX}")
    return OK


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
