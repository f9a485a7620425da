"""Cache the parts of an asset (pages, files), and rebuild each only when its inputs change.

The report is one page of a hundred tables, figures and pictures. Each is a piece: its content lies in an archive beside
the asset's state, together with digests of its inputs.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from traps_pipeline.base import progress
from traps_pipeline.base.archives import unzip_bytes, zip_bytes
from traps_pipeline.base.digests import digest
from traps_pipeline.pipeline.lineage import Lineage
from traps_pipeline.storage.workspace import Workspace

Digests = tuple[str, str]  # of the versions of what a piece reads, and of what it shows of it
NOTES = "inputs.json"  # archive member with the digests of each piece


@dataclass(frozen=True)
class Piece:
    """A part of an asset, such as a card of the report, that one process builds while others build the rest.

    reads: the stages and sources whose versions decide whether it is rebuilt.
    inputs: returns what it shows of them, as JSON; if their versions have changed, it is rebuilt only if this has, too.
    """

    name: str
    make: Callable[[], bytes]
    reads: Sequence[str] = ()
    inputs: Callable[[], Any] | None = None


def make_pieces(
    workspace: Workspace, stage: str, code: str, pieces: Sequence[Piece]
) -> tuple[dict[str, bytes], list[str]]:
    """Return the content of all parts by name, and the names of those that were rebuilt."""
    path = workspace.reports / ".state" / f"{stage}.pieces.zip"
    previous_pieces = _read(workspace.store.here(path).read_bytes()) if workspace.store.has(path) else {}
    versions = Lineage(workspace).inputs(stage, None)
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
            content = piece.make()
            rebuilt_names.append(piece.name)
        inputs[piece.name], contents[piece.name] = (versions_digest, inputs_digest), content
    if inputs != {name: digests for name, (digests, _) in previous_pieces.items()}:
        workspace.store.write({path: zip_bytes({NOTES: json.dumps(inputs).encode(), **contents}, level=1)})
    return contents, rebuilt_names


def _read(data: bytes) -> dict[str, tuple[Digests, bytes]]:
    """Return the digests and content of each piece; empty if the archive is damaged, or of an earlier version."""
    try:
        members = unzip_bytes(data)
        inputs = json.loads(members[NOTES]).items()
        return {name: ((str(versions), str(inputs)), members[name]) for name, (versions, inputs) in inputs}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
