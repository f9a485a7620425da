"""Check each family's real classes on a tiny checkpoint (`traps doctor --local`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import install_line, missing
from traps_pipeline.models.local.adapter import LocalModel, load_local_model
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompt_batches import Prompt
from traps_pipeline.models.local.tiny import Family, build_tiny
from traps_pipeline.models.registry.checkpoint import download_command, find_checkpoint
from traps_pipeline.models.registry.entries import LOCAL, ModelEntry, load_models
from traps_pipeline.models.registry.local_settings import Quantisation
from traps_pipeline.storage.media import MediaSpec, sample
from traps_pipeline.video.encode import encode

_SPEC = MediaSpec(profile="frames", uniform=4)
_SYSTEM, _QUESTION = "You are asked about a video.", "Does it grow brighter?"
# Vision towers of tiny checkpoints are too narrow for NF4 on a CPU; no library quantises the head.
_NF4_SKIP = ("model.visual", "lm_head")


def tiny_model(family: Family, folder: Path, quantisation: Quantisation = "none") -> LocalModel:
    """Load a family's tiny checkpoint, built if missing, with the real classes."""
    build_tiny(family, folder)
    params = {"checkpoint": str(folder), "dtype": "float32", "quantisation": quantisation}
    params |= {"do_sample": False, "max_new_tokens": 8, "nf4_skip": _NF4_SKIP if quantisation == "nf4" else ()}
    return load_local_model(ModelEntry(id="tiny", backend=LOCAL, device="cpu", media=_SPEC, params=params))


def _prompt(model: LocalModel, folder: Path) -> Prompt:
    clip = folder / "clip.mp4"
    encode([np.full((64, 96, 3), shade, np.uint8) for shade in range(40, 200, 20)], clip, fps=10)
    frames = sample(clip, _SPEC)
    return model.prompt(_SYSTEM, _QUESTION, frames.frames, frames.times_s)


def check_family(family: Family, folder: Path) -> str:
    """Build, save, reload and query a checkpoint; describe the result in words.

    Raises TrapsError, or any error of the library, if a step fails.
    """
    model = tiny_model(family, folder / family)
    (answer,) = model.generate([_prompt(model, folder)], 8)
    return f"{type(model.network).__name__} saved and reloaded, a clip answered ({answer.completion_tokens} tokens)"


def check_nf4(folder: Path) -> str:
    """Load a tiny checkpoint in 4 bits, if possible; describe the result in words."""
    if missing_modules := missing("nf4"):
        return f"{' and '.join(missing_modules)} not installed (`{install_line('nf4')}`): entries in NF4 do not load"
    model = tiny_model("qwen3-vl", folder / "nf4", "nf4")
    model.forward_states(_prompt(model, folder))
    import bitsandbytes

    return f"bitsandbytes {bitsandbytes.__version__}: a tiny model in NF4 read a clip"


def describe_devices() -> str:
    """Return the devices that torch finds, in words."""
    import torch

    versions = f"torch {torch.__version__}, transformers {load_transformers().__version__}"
    if not torch.cuda.is_available():
        return f"{versions}: no GPU; models of 7-8 B parameters want one of 24 GB or more, the pocket model does not"
    devices = [torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count())]
    return f"{versions}: " + ", ".join(
        f"cuda:{i} {p.name} {p.total_memory / 1e9:.0f} GB" for i, p in enumerate(devices)
    )


def describe_checkpoints() -> str:
    """Return the local models of the registry whose weights are present, in words."""
    return "; ".join(_whereabouts(entry) for entry in load_models().values() if entry.backend == LOCAL)


def _whereabouts(entry: ModelEntry) -> str:
    params = entry.local_params()
    try:
        return f"{entry.id} is here ({find_checkpoint(params).digest[:12]})"
    except TrapsError:
        return f"{entry.id} is not here ({download_command(params)})"
