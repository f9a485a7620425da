"""Give each item of a held-out set a clip of its own, which no byte links to another or to the study's."""

import os
import shutil
import struct
import tempfile
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base.cores import cores
from traps_pipeline.base.digests import file_digest
from traps_pipeline.benchmark.held_out import opaque_name
from traps_pipeline.video.encode import decode, encode

_BOX = struct.Struct(">I4s")  # size and type of a box of an mp4; players skip one of type `free`
_DATE = 315532800  # 1980-01-01, the time stamp of every file


def write_held_out_clips(
    items: Sequence[Mapping[str, Any]], sources: Mapping[str, Path], key: bytes, folder: Path
) -> dict[str, str]:
    """Write each item's clip to a folder, all of one size; return the digests by item.

    sources: the study's clips by path. A file is named by its digest.
    """
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        parts = {row["item_id"]: Path(scratch) / f"{opaque_name(key, row['item_id'])}.mp4" for row in items}
        with ThreadPoolExecutor(cores()) as pool:
            deque(pool.map(partial(_write_own_clip, sources, key, parts), items), maxlen=0)
        size, digests = max(path.stat().st_size for path in parts.values()) + _BOX.size, dict[str, str]()
        for item_id, path in parts.items():
            padding = size - path.stat().st_size
            with path.open("ab") as stream:
                stream.write(_BOX.pack(padding, b"free") + bytes(padding - _BOX.size))
            digests[item_id] = file_digest(path)
        # A folder and an archive may list files as they were created: in the order of their names, not of sides.
        for item_id in sorted(digests, key=lambda item: digests[item]):
            shutil.copyfile(parts[item_id], folder / clip_name(digests[item_id]))
    return digests


def clip_name(digest: str) -> str:
    """Return the file name of a held-out clip."""
    return f"{digest[:32]}.mp4"


def _write_own_clip(
    sources: Mapping[str, Path], key: bytes, parts: Mapping[str, Path], item: Mapping[str, Any]
) -> None:
    """Encode an item's frames anew, under noise of at most one level that its key draws."""
    frames, times = decode(sources[item["clip"]])
    rate = round((len(times) - 1) / float(times[-1] - times[0])) if len(times) > 1 else 1
    rng = np.random.default_rng(int(opaque_name(key, f"noise of {item['item_id']}"), 16))
    noise = rng.integers(-1, 2, frames.shape[1:], np.int16)
    encode([*np.clip(frames + noise, 0, 255).astype(np.uint8)], parts[item["item_id"]], rate)


def date_equally(folder: Path) -> None:
    """Give all files of a folder one time stamp: when each was written tells how long its clip is."""
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (_DATE, _DATE))
