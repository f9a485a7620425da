"""Extract hidden states of many items into shards (docs/spec.md 7.1).

    n_new = extract(model, items, folder, pooling="last")
    ids, states = read_layer(folder, 20)                # item_id, side, key, device; (n, d) float32 in the same order

A folder holds `shard-NNNNN.safetensors` (one key per layer, `layer_000` = embeddings, and `normed`), a `.parquet` file
beside each shard (the item in each row, and the device that made it), and `ids.parquet`, which is written last and
names the current row of each item. Each file holds digests of its content, which are looked at when it is read. A
shard's table is written after its tensors, so a shard with a table is complete, and an extraction that was killed
continues after the last such shard. An item's key is a digest of everything that its states depend on, so after a
correction only the corrected item is extracted again.

States of one token are stored in the model's own precision, which loses nothing, and mean states in float32.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from traps_pipeline.base import progress
from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.models.local.capture import OF_PAIRS, OF_PARTS, ONE_TOKEN, Pooling
from traps_pipeline.models.local.spans import changed_tokens, token_spans
from traps_pipeline.storage.leases import hold_lease, leased_ranges
from traps_pipeline.storage.media import MediaSpec, pick_frames, profile_digest
from traps_pipeline.storage.parquet import read_sealed, write_sealed
from traps_pipeline.storage.store import FolderStore

if TYPE_CHECKING:
    import pandas as pd
    import torch

    from traps_pipeline.models.local.adapter import LocalModel, Prompt, States

SHARD_SIZE = 64  # items of a chunk and its shard: 20 MB at the 8B size; a kill loses one shard at most
PREPARED_AHEAD = 2  # prompts prepared while the model works
NORMED = "normed"
_IDS = "ids.parquet"
_WRITING = "shards"  # lease of the process that writes into a folder
_RECORD = b"traps"
_COLUMNS = ("item_id", "side", "key", "shard", "row", "device")


@dataclass(frozen=True)
class Item:
    """A forward pass to run; about: all that the states depend on, for the key.

    prompt: builds the prompt, called only if the states are missing; other: the same for the pair's other clip, for
    poolings over differences.
    """

    item_id: str
    side: str
    about: Mapping[str, Any]
    prompt: Callable[[], Prompt]
    other: Callable[[], Prompt] | None = None


_ItemStates = tuple[Item, str, "States"]  # an item, its key, its states
_Place = tuple[str, int, str]  # shard, row and device of an item's states


def clip_item(
    model: LocalModel, spec: MediaSpec, row: Mapping[str, Any], clip: Path, system: str,
    other: tuple[Path, str] | None = None,
) -> Item:  # fmt: skip
    """Return the item that asks a question about a clip under a system prompt.

    row: a row of the items table (item_id, side, question, media_digest). spec: how the model is shown a clip. other:
    the pair's other clip and its SHA-256, if the pooling depends on it.
    """

    def asked(frames_of: Path) -> Prompt:
        frames = pick_frames(frames_of, spec)
        return model.prompt(system, row["question"], frames.frames, frames.times_s)

    key_parts = {
        "question": row["question"],
        "clip": row["media_digest"],
        "media": profile_digest(spec),
        "system": system,
    }
    key_parts |= {"other": other[1]} if other else {}
    return Item(
        row["item_id"], row["side"], key_parts, partial(asked, clip), partial(asked, other[0]) if other else None
    )


def states_key(model: LocalModel, item: Item, pooling: Pooling) -> str:
    """Return the digest of an item's states: prompt, checkpoint, precision, pooling."""
    return digest({"about": dict(item.about), "model": model.identity, "pooling": pooling})


def extract(
    model: LocalModel,
    items: Sequence[Item],
    folder: Path,
    *,
    pooling: Pooling = "last",
    shard_size: int = SHARD_SIZE,
    noun: str = "items",
) -> int:
    """Compute missing states, one pass each, and write current rows; return the number computed.

    Several processes may work at one folder: each takes free chunks of `shard_size` items. If one ends early (Ctrl-C,
    an error, a kill), the states made so far are written, except for the chunk that a kill interrupts, and the others
    or the same call continue there. what: names the items in the progress line. Raises TrapsError if the disk cannot be
    written.
    """
    keys = [states_key(model, item, pooling) for item in items]
    places, count, local_files = dict[str, _Place](), 0, FolderStore(folder)
    with hold_lease(local_files, _WRITING):
        _look_for(folder, places)
    total = sum(key not in places for key in keys)
    for chunk in leased_ranges(local_files, "chunks", len(items), shard_size):
        if any(keys[n] not in places for n in chunk):
            _look_for(folder, places)  # another process may have made this chunk
        missing = [(items[n], keys[n]) for n in chunk if keys[n] not in places]
        if missing:
            tick = partial(_tick, noun, count, total)
            count += _make(model, missing, folder, pooling, tick, places)
    with hold_lease(local_files, _WRITING):
        _write_ids(folder, items, keys, places, _record(model, pooling))
        _sweep(folder, {places[key][0] for key in keys})
    _note_devices(folder, sorted({places[key][2] for key in keys}))
    return count


def _tick(noun: str, before: int, total: int, done: int) -> None:
    progress.current().tick("hidden_states", noun, min(before + done, total), total)


def _look_for(folder: Path, places: dict[str, _Place]) -> None:
    """Add the contents of new shards."""
    names = {shard for shard, _, _ in places.values()}
    for shard, table in _shards(folder, names):
        for row, (key, device) in enumerate(zip(table["key"], table["device"], strict=True)):
            places[key] = (shard, row, device)


def read_layer(folder: Path, layer: int | Literal["normed"]) -> tuple[pd.DataFrame, np.ndarray]:
    """Return a layer's items (item_id, side, key, device) as a frame, and their states (n, d) float32.

    layer: 0 (embeddings) to n_layers (the last block's output), or `normed` (the latter after the final norm). Raises
    TrapsError for an extraction that is not finished, a layer that does not exist, or a damaged shard.
    """
    ids, record = _ids(folder)
    name = NORMED if layer == NORMED else f"layer_{layer:03d}"
    if layer != NORMED and not 0 <= int(layer) <= record["n_layers"]:
        raise TrapsError(
            f"{folder}: no layer {layer}; {record['checkpoint']} has 0 (embeddings) to {record['n_layers']}, and "
            f"`{NORMED}`"
        )
    states = np.empty((len(ids), record["d_model"]), np.float32)
    for shard, rows in ids.groupby("shard"):
        states[rows.index] = _tensor(folder / f"{shard}.safetensors", name)[rows["row"]]
    return ids.drop(columns=["shard", "row"]), states


def read_record(folder: Path) -> dict[str, Any]:
    """Return an extraction's settings. Raises TrapsError for an unfinished one."""
    return _ids(folder)[1]


# --- inside -----------------------------------------------------------------------------------------------------------


def _make(
    model: LocalModel,
    missing: Sequence[tuple[Item, str]],
    folder: Path,
    pooling: Pooling,
    tick: Callable[[int], None],
    places: dict[str, _Place],
) -> int:
    """Run one pass per item; write a shard, even after an error; return items done."""
    shard: list[_ItemStates] = []
    try:
        for n_finished, ((item, key), prompt) in enumerate(_prepare_ahead(missing), start=1):
            shard.append((item, key, item_states(model, item, prompt, pooling)))
            tick(n_finished)
    finally:
        with hold_lease(FolderStore(folder), _WRITING):
            _flush(folder, shard, model, pooling, places)
    return len(missing)


def item_states(model: LocalModel, item: Item, prompt: Prompt, pooling: Pooling) -> States:
    """Return the states of an item, pooled over the tokens that the pooling names."""
    positions = _pooled_tokens(model, prompt, item, pooling)
    with model.caching_clips():
        return model.forward_states(prompt, pooling, chosen=positions)


def _pooled_tokens(model: LocalModel, prompt: Prompt, item: Item, pooling: Pooling) -> np.ndarray | None:
    """Return the tokens over which states are pooled, or None if there is no mask."""
    if pooling not in OF_PARTS:
        return None
    parts = token_spans(model, prompt, item.about["system"], item.about["question"])
    positions = parts[pooling] if pooling not in OF_PAIRS else _pair_masks(parts["visual"], prompt, item)[pooling]
    if not positions.any():
        raise TrapsError(
            f"{item.item_id}: its prompt for {model.checkpoint.name} has no {pooling}; choose another pooling"
        )
    return positions


def _pair_masks(visual: np.ndarray, prompt: Prompt, item: Item) -> dict[str, np.ndarray]:
    is_changed = changed_tokens(prompt, item.other(), visual) if item.other else None
    if is_changed is None:
        raise TrapsError(
            f"{item.item_id}: its visual tokens cannot be compared with those of the pair's other clip (not as many, "
            "or pixels that do not come token by token); choose another pooling"
        )
    return {"changed": is_changed, "unchanged": visual & ~is_changed}


def _prepare_ahead(missing: Sequence[tuple[Item, str]]) -> Iterator[tuple[tuple[Item, str], Prompt]]:
    """Yield items with their prompts, preparing the next ones while the model works."""
    with ThreadPoolExecutor(1) as pool:
        queue: deque[tuple[tuple[Item, str], Future[Prompt]]] = deque()
        try:
            for pair in missing:
                queue.append((pair, pool.submit(pair[0].prompt)))
                if len(queue) > PREPARED_AHEAD:
                    first, prompt = queue.popleft()
                    yield first, prompt.result()
            while queue:
                first, prompt = queue.popleft()
                yield first, prompt.result()
        finally:
            for _, prompt in queue:
                prompt.cancel()


def _flush(
    folder: Path, shard: Sequence[_ItemStates], model: LocalModel, pooling: Pooling, places: dict[str, _Place]
) -> None:
    """Write a shard under the next free number, tensors first, and note its items."""
    if not shard:
        return
    import pyarrow as pa
    import torch
    from safetensors.torch import save

    number = 1 + max((int(path.stem.split("-")[1]) for path in folder.glob("shard-*.safetensors")), default=-1)
    name = f"shard-{number:05d}"
    dtype = model.network.dtype if pooling in ONE_TOKEN else torch.float32
    raw = torch.from_numpy(np.stack([states.raw for _, _, states in shard], axis=1)).to(dtype)  # (layers, n, d)
    tensors = {f"layer_{layer:03d}": rows.contiguous() for layer, rows in enumerate(raw)}
    tensors[NORMED] = torch.from_numpy(np.stack([states.normed for _, _, states in shard])).to(dtype)
    seals = {name: _seal_of(rows) for name, rows in tensors.items()}
    write_bytes(folder / f"{name}.safetensors", save(tensors, metadata=seals), durable=True)
    rows = [(item.item_id, item.side, key, model.device_name) for item, key, _ in shard]
    columns = zip(("item_id", "side", "key", "device"), zip(*rows, strict=True), strict=True)
    write_sealed(folder / f"{name}.parquet", pa.table({column: list(values) for column, values in columns}), {})
    places.update({key: (name, row, device) for row, (_, _, key, device) in enumerate(rows)})


def _shards(folder: Path, seen: Container[str]) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield name and table of complete shards not in `seen`; orphans are swept."""
    for path in sorted(path for path in folder.glob("shard-*.parquet") if path.stem not in seen):
        try:
            table = read_sealed(path).to_pandas()
            rows = _count_sound_rows(path.with_suffix(".safetensors"))
        except (OSError, ValueError, TrapsError) as error:
            progress.current().note(f"{path}: damaged ({error}); its items are extracted again")
            continue
        if rows == len(table):
            yield path.stem, table


def _write_ids(
    folder: Path, items: Sequence[Item], keys: Sequence[str], places: Mapping[str, _Place], record: Mapping[str, Any]
) -> None:
    import pandas as pd
    import pyarrow as pa

    rows = [(item.item_id, item.side, key, *places[key]) for item, key in zip(items, keys, strict=True)]
    table = pa.Table.from_pandas(pd.DataFrame(rows, columns=list(_COLUMNS)), preserve_index=False)
    write_sealed(folder / _IDS, table, {_RECORD: json.dumps(record).encode()})


def _ids(folder: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    try:
        table = read_sealed(folder / _IDS)
        record = json.loads((table.schema.metadata or {})[_RECORD])
    except FileNotFoundError:
        raise TrapsError(f"{folder}: hidden states are missing or not finished; materialize hidden_states") from None
    except (OSError, ValueError, KeyError) as error:
        raise TrapsError(f"{folder / _IDS}: cannot be read ({error}); the next `traps run` writes it again") from error
    return table.to_pandas(), record


def _record(model: LocalModel, pooling: Pooling) -> dict[str, Any]:
    return {
        **model.identity,
        "checkpoint": model.checkpoint.name,
        "pooling": pooling,
        "n_layers": model.n_layers,
        "d_model": model.d_model,
    }


def _tensor(file: Path, name: str) -> np.ndarray:
    """Return one tensor of a shard as float32, or raise TrapsError if it is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, framework="pt") as shard:
            tensor, seals = shard.get_tensor(name), shard.metadata()
        if (seals or {}).get(name) != _seal_of(tensor):
            raise OSError("it was altered")
        return tensor.float().numpy()
    except (OSError, SafetensorError) as error:
        raise TrapsError(
            f"{file}: cannot be read ({error}); delete it, then `traps run` extracts its items again"
        ) from error


def _count_sound_rows(file: Path) -> int:
    """Return how many items a shard holds, or raise TrapsError if it is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, framework="pt") as shard:
            names = [*shard.keys()]
    except (OSError, SafetensorError) as error:
        raise TrapsError(f"{file}: cannot be read ({error})") from error
    rows = {len(_tensor(file, name)) for name in {*names, NORMED}}
    if len(rows) > 1:
        raise TrapsError(f"{file}: its tensors have {sorted(rows)} rows")
    return rows.pop()


def damage(file: Path) -> str:
    """Return in words what is wrong with a file of an extraction; empty if nothing is."""
    try:
        _count_sound_rows(file) if file.suffix == ".safetensors" else read_sealed(file)
    except (OSError, ValueError, TrapsError) as error:
        return str(error) if str(file) in str(error) else f"{file}: cannot be read ({error})"
    return ""


def _seal_of(tensor: torch.Tensor) -> str:
    import torch

    return hashlib.sha256(tensor.contiguous().view(torch.uint8).numpy().data).hexdigest()


def _sweep(folder: Path, needed: set[str]) -> None:
    """Remove the shards without any current row."""
    for path in folder.glob("shard-*"):
        if path.name.split(".")[0] not in needed:
            path.unlink()


def _note_devices(folder: Path, devices: Sequence[str]) -> None:
    if len(devices) > 1:
        progress.current().note(
            f"{folder}: its states were made on {' and '.join(devices)} (column `device` of hidden_states), whose "
            "rounding differs; to get all states from one device, delete the folder and run again"
        )
