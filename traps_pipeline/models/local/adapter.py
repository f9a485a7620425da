"""Adapt any image-text-to-text model: prompts go in, hidden states and answers come out.

    model = load_local_model(get_model("pocket"))
    prompt = model.prompt(system, question, frames, times_s)      # frames (N, H, W, 3) uint8, seconds into the clip
    states = model.forward_states(prompt)                         # .raw (n_layers + 1, d), .normed (d,), float32
    answers = model.generate([prompt, prompt], 64, steering=None) # greedy; `Sampling` for temperature and top-p

Nothing in it knows a family. A model fits if the Auto classes load it, its processor takes videos and a chat template,
and its decoder (`get_decoder()`) has `layers` and `norm`; anything else is refused by name. Not for several threads at
once: one prompt's hooks would see another's states (`backend` uses one worker thread for all models).
"""

import gc
from collections import OrderedDict
from dataclasses import replace
from threading import Lock
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.wording import count_noun
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.model import GeneratedAnswer, LocalModel, States
from traps_pipeline.models.local.prompt_batches import Prompt
from traps_pipeline.models.local.sampling import Sampling
from traps_pipeline.models.registry.checkpoint import (
    Checkpoint,
    find_checkpoint,
    free_bytes,
    require_memory,
    require_no_code,
    weight_bytes,
)
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.local_settings import SPREAD, LocalParams

__all__ = ["GeneratedAnswer", "LocalModel", "Prompt", "Sampling", "States", "load_local_model", "require_device"]

NF4_CPU_BLOCK = 64
_UNQUANTISED = {"quantisation": "none", "nf4_skip": ()}
WEIGHTS_SHARE = 0.7  # share of free memory for weights before other models are unloaded; the rest is for batches
_LOADED: OrderedDict[str, LocalModel] = OrderedDict()  # the most recently used one comes last
_LOADING = Lock()


def load_local_model(entry: ModelEntry, *, inside: bool = False, seed: int | None = None) -> LocalModel:
    """Return the entry's checkpoint in memory, loaded once per process.

    seed: give the same network random weights of this seed instead, as its class initialises them, unquantised.

    It is unloaded if another model needs its memory. inside: load it for mechanistic analyses (`mechanism:` of the
    entry), not for answers. Raises TrapsError if weights, device, memory or library are missing, or if the checkpoint's
    class does not fit.
    """
    params = entry.inside_params() if inside else entry.local_params()
    device = entry.device or "cpu"
    require_device(device)
    checkpoint = find_checkpoint(params)
    require_no_code(checkpoint)
    if seed is not None:
        device = _one_device() if device == SPREAD else device
        name, params = f"{checkpoint.name}, random weights {seed}", params.model_copy(update=_UNQUANTISED)
        checkpoint = replace(checkpoint, name=name, digest=digest([checkpoint.digest, seed]))
    loading_params = ("dtype", "quantisation", "nf4_skip", "attn_implementation", "template", "video")
    key = digest(
        [checkpoint.digest, str(checkpoint.folder), device, params.model_dump(mode="json", include={*loading_params})]
    )
    with _LOADING:
        if key not in _LOADED:
            _make_room(checkpoint, params, device)
            require_memory(checkpoint, params.dtype, params.quantisation, device)
            _LOADED[key] = _load(checkpoint, params, device, seed)
        _LOADED.move_to_end(key)
        return _LOADED[key]


def _make_room(checkpoint: Checkpoint, params: LocalParams, device: str) -> None:
    """Unload a device's least recently used models until the weights fit; callers may still hold their memory."""
    import torch

    needed_bytes = weight_bytes(checkpoint.folder, params.dtype, params.quantisation)
    loaded_keys = [key for key, model in _LOADED.items() if SPREAD in (device, model.device) or model.device == device]
    for key in loaded_keys:
        if needed_bytes <= WEIGHTS_SHARE * free_bytes(device):
            return
        del _LOADED[key]
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()


def require_device(device: str) -> None:
    """Raise TrapsError if this machine has no such device."""
    import torch

    is_available = device in ("cpu", SPREAD) or (device == "mps" and torch.backends.mps.is_available())
    if device.startswith("cuda"):
        number = int(device.partition(":")[2] or 0)
        is_available = torch.cuda.is_available() and number < torch.cuda.device_count()
    if not is_available:
        raise TrapsError(
            f"device {device}: torch {torch.__version__} finds none on this machine; run where there is one, or say "
            "`device: cpu` in the entry, which changes nothing but the speed in float32"
        )


def _load(checkpoint: Checkpoint, params: LocalParams, device: str, seed: int | None) -> LocalModel:
    transformers = load_transformers()
    options = _precision(params, device)
    try:
        processor = transformers.AutoProcessor.from_pretrained(
            checkpoint.folder, local_files_only=True, trust_remote_code=False
        )
        # Without `trust_remote_code=False` transformers asks on the terminal, and a `y` runs the code.
        common = {"attn_implementation": params.attn_implementation, "trust_remote_code": False}
        if seed is None:
            network, report = transformers.AutoModelForImageTextToText.from_pretrained(
                checkpoint.folder,
                local_files_only=True,
                use_safetensors=True,
                output_loading_info=True,
                **common,
                **options,
            )
        else:
            network, report = _random_network(checkpoint, seed, common | {"dtype": options["dtype"]}), {}
    except (OSError, ValueError, LookupError, ImportError, RuntimeError, AttributeError, TypeError) as error:
        message = " ".join(str(error).split())[:400]
        lacks_package = isinstance(error, ImportError)  # as num2words, which the processor of SmolVLM wants
        remedy = "install that package" if lacks_package else "save it again with this version"
        raise TrapsError(
            f"checkpoint {checkpoint.name}: transformers {transformers.__version__} cannot load it as an "
            f"image-text-to-text model ({type(error).__name__}: {message}); {remedy}, or name another checkpoint"
        ) from error
    unset = [*report.get("missing_keys", ()), *report.get("mismatched_keys", ())]
    if unset:
        raise TrapsError(
            f"checkpoint {checkpoint.name}: its files lack {count_noun(len(unset), 'weight')}, {unset[0]} first, which "
            "would be random: download or save it again"
        )
    if not hasattr(processor, "video_token") or getattr(processor, "video_processor", None) is None:
        raise TrapsError(
            f"checkpoint {checkpoint.name}: {type(processor).__name__} takes no videos; name a model that does"
        )
    processor.tokenizer.padding_side = "left"
    if params.quantisation == "none" and device != SPREAD:
        network = network.to(device)
    elif device == "cpu":
        _require_packable(network, checkpoint.name)
    return LocalModel(network.eval().requires_grad_(False), processor, checkpoint, params, device)


def _one_device() -> str:
    import torch

    return "cuda:0" if torch.cuda.is_available() else "cpu"


def _random_network(checkpoint: Checkpoint, seed: int, options: dict[str, Any]) -> Any:
    """Return a network of the checkpoint's class and configuration, initialised on the CPU by a seed."""
    import torch

    transformers = load_transformers()
    config = transformers.AutoConfig.from_pretrained(checkpoint.folder, local_files_only=True, trust_remote_code=False)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return transformers.AutoModelForImageTextToText.from_config(config, **options)


def _require_packable(network: Any, name: str) -> None:
    """Raise TrapsError for modules that bitsandbytes cannot pack on a CPU (rows % 64)."""
    odd_layers = [
        part
        for part, module in network.named_modules()
        if type(module).__name__ == "Linear4bit" and module.in_features % NF4_CPU_BLOCK
    ]
    if odd_layers:
        raise TrapsError(
            f"checkpoint {name}: NF4 on a CPU wants modules {NF4_CPU_BLOCK} weights wide or a multiple of it, and "
            f"{len(odd_layers)}, {odd_layers[0]} first, are not: name them, or what holds them, under nf4_skip beside "
            "the entry's quantisation: nf4 (in params or in mechanism), or use a GPU"
        )


def _precision(params: LocalParams, device: str) -> dict[str, Any]:
    """Return precision arguments of `from_pretrained`. Raises TrapsError without NF4."""
    import torch

    options: dict[str, Any] = {"dtype": getattr(torch, params.dtype)}
    if params.quantisation == "nf4":
        require_extra("nf4")
        options["quantization_config"] = load_transformers().BitsAndBytesConfig(
            load_in_4bit=True,
            bnb_4bit_quant_type="nf4",
            bnb_4bit_compute_dtype=options["dtype"],
            llm_int8_skip_modules=list(params.nf4_skip) or None,
        )
        options["device_map"] = {"": device}
    if device == SPREAD:
        require_extra("nf4", "accelerate")
        options["device_map"] = "auto"
    return options
