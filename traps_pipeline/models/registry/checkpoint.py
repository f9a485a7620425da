"""Find and identify a local checkpoint (no download); check that it fits memory."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.paths import ROOT
from traps_pipeline.models.registry.local_settings import SPREAD, Dtype, LocalParams, Quantisation

_FILES = (".json", ".jinja", ".model", ".safetensors", ".txt")  # files of a folder that decide the model's output
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
_COMMIT = re.compile(r"[0-9a-f]{40}")
_CONFIG_BYTES = 4 * 2**20  # maximum bytes of a settings file; a vocabulary is larger, and names no class
_ITEM_BYTES: dict[Dtype, int] = {"float32": 4, "bfloat16": 2, "float16": 2}
NF4_BYTES = 0.77  # bytes of a weight in 4 bits with its share of scales, embeddings and head (measured, Qwen3-VL-8B)


@dataclass(frozen=True)
class Checkpoint:
    """A local checkpoint; `digest` is the hub's commit, or that of the content."""

    name: str
    folder: Path
    digest: str


def as_folder(name: str) -> Path | None:
    """Return the path of a `checkpoint:` folder, relative to the checkout; None for a hub id."""
    folder = ROOT / name
    return folder if folder.is_dir() or not _HUB_ID.fullmatch(name) else None


def find_checkpoint(params: LocalParams) -> Checkpoint:
    """Return an entry's checkpoint. Raises TrapsError with the download command."""
    require_extra("local")
    folder = as_folder(params.checkpoint)
    if folder is not None:
        _require_whole(folder, params.checkpoint, f"set checkpoint: to a folder saved by save_pretrained ({folder})")
        return Checkpoint(params.checkpoint, folder, folder_digest(folder))
    snapshot = _cached_snapshot(params)
    if snapshot is None:
        raise TrapsError(
            f"checkpoint {params.checkpoint}: neither a folder nor in the hub's cache on this machine; with a network "
            f"run `{download_command(params)}` (older versions: huggingface-cli download), or copy the weights here "
            "and set `checkpoint:` of the entry to their folder"
        )
    _require_whole(snapshot, params.checkpoint, f"run `{download_command(params)}` again to complete it")
    return Checkpoint(params.checkpoint, snapshot, snapshot.name)


def declared_digest(params: LocalParams) -> str | None:
    """Return the weights' digest, which stands beside the entry in the ledger key.

    For a folder it is the digest of its content, for a hub id the commit in the hub's cache. None for a hub id whose
    `revision` is a commit, and for one that is not downloaded: it can be planned, and must be downloaded before it is
    asked (`find_checkpoint`). Raises TrapsError if the folder is missing.
    """
    folder = as_folder(params.checkpoint)
    if folder is not None:
        _require_whole(folder, params.checkpoint, f"set checkpoint: to a folder saved by save_pretrained ({folder})")
        return folder_digest(folder)
    if params.revision is not None and _COMMIT.fullmatch(params.revision):
        return None
    snapshot = _cached_snapshot(params)
    return None if snapshot is None else snapshot.name


def download_command(params: LocalParams) -> str:
    """Return the command that downloads a hub id's weights."""
    revision = f" --revision {params.revision}" if params.revision else ""
    return f"hf download {params.checkpoint}{revision}"


def _cached_snapshot(params: LocalParams) -> Path | None:
    """Return a hub id's cached folder, named by its commit; None if missing."""
    if find_spec("huggingface_hub") is None:
        return None  # without the extra `local` the model can be planned; `find_checkpoint` then says what is missing
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    try:
        config = try_to_load_from_cache(params.checkpoint, "config.json", revision=params.revision)
    except (OSError, HFValidationError):
        return None
    return Path(config).parent if isinstance(config, str) else None


def _require_whole(folder: Path, name: str, remedy: str) -> None:
    """Raise TrapsError unless configuration and all weights are there."""
    try:
        index = folder / "model.safetensors.index.json"
        shards = set(json.loads(index.read_text())["weight_map"].values()) if index.exists() else {"model.safetensors"}
    except (OSError, ValueError, KeyError) as error:
        raise TrapsError(f"checkpoint {name}: {folder}: the index of weights cannot be read ({error})") from error
    missing = [file for file in ("config.json", *sorted(shards)) if not (folder / file).exists()]
    if missing:
        raise TrapsError(f"checkpoint {name}: {folder / missing[0]} is missing ({len(missing)} files are); {remedy}")


def require_no_code(checkpoint: Checkpoint) -> None:
    """Raise TrapsError for a checkpoint that brings its own code."""
    code = [path.relative_to(checkpoint.folder).as_posix() for path in sorted(checkpoint.folder.rglob("*.py"))]
    for path in sorted(checkpoint.folder.glob("*.json")):
        if path.stat().st_size <= _CONFIG_BYTES and _has_own_code(path):
            code.append(f"auto_map in {path.name}")
    if code:
        suffix = f" and {len(code) - 1} more" if len(code) > 1 else ""
        raise TrapsError(
            f"checkpoint {checkpoint.name}: it brings code of its own ({code[0]}{suffix}), which never runs here: name "
            "a checkpoint of a class that transformers has itself, or one that was saved again by such a class"
        )


def _has_own_code(path: Path) -> bool:
    """Return whether settings name classes of own files, in any JSON spelling."""
    try:
        return '"auto_map"' in json.dumps(json.loads(path.read_bytes()))
    except (ValueError, RecursionError):
        return False  # nothing that transformers reads either


def folder_digest(folder: Path) -> str:
    """Return the digest of a folder's content, cached until a file changes."""
    files = sorted(path for path in folder.iterdir() if path.suffix in _FILES)
    stamps = tuple((path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files)
    return _content_digest(folder, stamps)


@lru_cache(maxsize=64)
def _content_digest(folder: Path, stamps: tuple[tuple[str, int, int], ...]) -> str:
    return digest({name: file_digest(folder / name) for name, _, _ in stamps})


def weight_bytes(folder: Path, dtype: Dtype, quantisation: Quantisation) -> float:
    """Return the weights' bytes of memory at a precision, from their files' headers."""
    weights = sum(math.prod(shape) for file in sorted(folder.glob("*.safetensors")) for shape in _shapes(file))
    return weights * (NF4_BYTES if quantisation == "nf4" else _ITEM_BYTES[dtype])


def _shapes(file: Path) -> list[Sequence[int]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, framework="np") as tensors:
            return [tensors.get_slice(name).get_shape() for name in tensors.keys()]  # noqa: SIM118 - no mapping
    except (OSError, SafetensorError) as error:
        raise TrapsError(f"{file}: no safetensors file ({error}); download or save the checkpoint again") from error


def free_bytes(device: str) -> float:
    """Return a device's free bytes of memory; infinite if they are unknown."""
    if device == SPREAD:
        import torch

        if torch.cuda.is_available():
            return sum(free_bytes(f"cuda:{number}") for number in range(torch.cuda.device_count()))
    if device.startswith("cuda"):
        import torch

        cached_bytes = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(
            device
        )  # torch's cache can reuse it
        return float(torch.cuda.mem_get_info(device)[0] + cached_bytes)
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return math.inf
    return next((float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable")), math.inf)


def require_memory(checkpoint: Checkpoint, dtype: Dtype, quantisation: Quantisation, device: str) -> None:
    """Raise TrapsError if the weights alone do not fit."""
    needed_bytes, free = weight_bytes(checkpoint.folder, dtype, quantisation), free_bytes(device)
    if needed_bytes > free:
        raise TrapsError(
            f"checkpoint {checkpoint.name}: its weights take about {needed_bytes / 1e9:.1f} GB as {dtype}"
            f"{' in NF4' if quantisation == 'nf4' else ''}, and {free / 1e9:.1f} GB are free on {device}: free memory "
            "(another model of this run may hold it: ask one at a time), choose another device, or say quantisation: "
            "nf4 in the entry, which makes it another model"
        )
