"""Cache the parts of an asset, and rebuild each only when its inputs change.

The report is one page of a hundred tables, figures and pictures. Each is a piece: its content lies in an archive beside
the asset's state, together with digests of its inputs.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.archives import unzip_bytes, zip_bytes
from traps_pipeline.base.digests import digest
from traps_pipeline.base.files import write_bytes
from traps_pipeline.base.paths import user_cache
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.storage.workspace import Workspace

Digests = tuple[str, str]  # of the versions of what a piece reads, and of what it shows of it
NOTES = "inputs.json"  # archive member with the digests of each piece
_DRAWN_BY = ("matplotlib", "pandas", "jinja2")  # libraries whose versions decide what a piece looks like


@dataclass(frozen=True)
class Piece:
    """One part of an asset.

    reads: the stages and sources whose versions decide whether it is rebuilt.
    inputs: returns what it shows of them, as JSON; if their versions have changed, it is rebuilt only if this has, too.
    is_shared: whether all studies have the same; it is then built once per user.
    """

    name: str
    make: Callable[[], bytes]
    reads: Sequence[str] = ()
    inputs: Callable[[], Any] | None = None
    is_shared: bool = False


def make_pieces(
    workspace: Workspace, stage: str, code: str, pieces: Sequence[Piece]
) -> tuple[dict[str, bytes], list[str]]:
    """Return all pieces' content, and names of those rebuilt for new inputs or code."""
    path = workspace.reports / ".state" / f"{stage}.pieces.zip"
    previous_pieces = _read(workspace.store.here(path).read_bytes()) if workspace.store.has(path) else {}
    versions, shared_pieces = Lineage(workspace).inputs(stage, None), _SharedPieces(stage)
    inputs, contents, rebuilt_names = dict[str, Digests](), dict[str, bytes](), list[str]()
    for number, piece in enumerate(pieces):
        progress.current().tick(stage, "parts", number, len(pieces))
        read_versions = {name: version for name, version in versions.items() if name.partition("/")[0] in piece.reads}
        digests, content = previous_pieces.get(piece.name, (("", ""), b""))
        versions_digest = inputs_digest = digest([code, read_versions])
        if digests[0] == versions_digest:
            inputs_digest = digests[1]
        elif piece.inputs is not None:
            inputs_digest = digest([code, piece.inputs()])
        if digests[1] != inputs_digest:
            content = shared_pieces.get(piece, inputs_digest) if piece.is_shared else piece.make()
            rebuilt_names.append(piece.name)
        inputs[piece.name], contents[piece.name] = (versions_digest, inputs_digest), content
    shared_pieces.save()
    if inputs != {name: digests for name, (digests, _) in previous_pieces.items()}:
        workspace.store.write({path: _archive(inputs, contents)})
    return contents, rebuilt_names


class _SharedPieces:
    """An archive of all studies' shared pieces in the user's cache folder; if it fails, pieces are built without it."""

    def __init__(self, asset: str) -> None:
        self._asset, self._libraries = asset, [*map(version, _DRAWN_BY)]
        self._pieces: dict[str, tuple[Digests, bytes]] | None = None
        self._is_new = False

    def get(self, piece: Piece, inputs: str) -> bytes:
        """Return the content of a piece, built if it is not in the archive."""
        if self._pieces is None:
            self._pieces = {}
            with suppress(OSError, RuntimeError):  # RuntimeError: a user without a home folder
                self._pieces = _read(self._path.read_bytes())
        inputs_digest = digest([inputs, *self._libraries])
        inputs_digests = (inputs_digest, inputs_digest)
        digests, content = self._pieces.get(piece.name, (("", ""), b""))
        if digests != inputs_digests:
            content = piece.make()
            self._pieces[piece.name], self._is_new = (inputs_digests, content), True
        return content

    def save(self) -> None:
        """Store the newly built pieces."""
        if self._pieces and self._is_new:
            inputs = {name: inputs_digest for name, (inputs_digest, _) in self._pieces.items()}
            contents = {name: content for name, (_, content) in self._pieces.items()}
            with suppress(OSError, RuntimeError):
                write_bytes(self._path, _archive(inputs, contents))

    @property
    def _path(self) -> Path:
        return user_cache() / f"{self._asset}.pieces.zip"


def _archive(inputs: Mapping[str, Digests], contents: Mapping[str, bytes]) -> bytes:
    return zip_bytes({NOTES: json.dumps(inputs).encode(), **contents}, level=1)


def _read(data: bytes) -> dict[str, tuple[Digests, bytes]]:
    """Return the digests and content of each piece; empty if the archive is damaged, or of an earlier version."""
    try:
        members = unzip_bytes(data)
        inputs = json.loads(members[NOTES]).items()
        return {name: ((str(versions), str(inputs)), members[name]) for name, (versions, inputs) in inputs}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
