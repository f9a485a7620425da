"""Assets that hold many files, of which only those are made again whose inputs changed.

The report's tables and figures are one asset each, as a reader of the graph would draw them. A piece is one table,
figure or picture. Beside the asset's own state lies a note of what each piece was made from, and of the digests of its
files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.storage.workspace import Workspace

Files = dict[str, bytes]  # content by path below the workspace's reports


@dataclass(frozen=True)
class Piece:
    """One table or figure. make: its files.

    reads: the stages and sources that it is made from; it is made again when a version of one changes. inputs: where a
    table is not looked at whole, the part that is, as JSON, which is compared instead.
    """

    name: str
    make: Callable[[], Files]
    reads: Sequence[str] = ()
    inputs: Any = None


@dataclass(frozen=True)
class _Note:
    """What a piece was made from, as a digest, and the SHA-256 of each of its files."""

    inputs: str
    files: Mapping[str, str]


def make_pieces(workspace: Workspace, stage: str, code: str, pieces: Sequence[Piece]) -> tuple[Files, list[str]]:
    """Return the files of all pieces, and the names of those that were made again.

    A piece is taken as it lies there if its inputs and the stage's code are those that it was made from, and its files
    are what was written. Files of pieces that are no more are removed.
    """
    path = workspace.reports / ".state" / f"{stage}.pieces.json"
    notes, now, files, remade = _read(workspace, path), dict[str, _Note](), Files(), list[str]()
    versions = Lineage(workspace).inputs(stage, None)
    for piece in pieces:
        mine = {name: version for name, version in versions.items() if name.partition("/")[0] in piece.reads}
        inputs, note = digest([code, mine if piece.inputs is None else piece.inputs]), notes.get(piece.name)
        content = _unchanged(workspace, note) if note is not None and note.inputs == inputs else None
        if content is None:
            content = piece.make()
            remade.append(piece.name)
        files |= content
        now[piece.name] = _Note(inputs, {name: hashlib.sha256(data).hexdigest() for name, data in content.items()})
    former = {name for note in notes.values() for name in note.files}
    workspace.store.remove(workspace.reports / name for name in sorted(former - files.keys()))
    text = json.dumps({name: [note.inputs, note.files] for name, note in now.items()})
    workspace.store.write({path: text.encode()})
    return files, remade


def _read(workspace: Workspace, path: Path) -> dict[str, _Note]:
    """Return the notes of an asset; none where there are none, or they cannot be read: all pieces are made again."""
    if not workspace.store.has(path):
        return {}
    try:
        return {name: _Note(*note) for name, note in json.loads(workspace.store.here(path).read_bytes()).items()}
    except (ValueError, TypeError, AttributeError):
        return {}


def _unchanged(workspace: Workspace, note: _Note) -> Files | None:
    """Return the files of a piece as they lie there; None if one of them is gone or altered."""
    files = Files()
    for name, expected in note.files.items():
        path = workspace.reports / name
        if not workspace.store.has(path):
            return None
        files[name] = workspace.store.here(path).read_bytes()
        if hashlib.sha256(files[name]).hexdigest() != expected:
            return None
    return files
