"""Say what this machine has for local models (`traps doctor --local`): devices, NF4, weights."""

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import find_missing, install_line
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.registry.checkpoint import download_command, find_checkpoint
from traps_pipeline.models.registry.entries import LOCAL, ModelEntry, load_models


def describe_nf4() -> str:
    """Pass a vector through a layer in 4 bits, if possible; describe the result in words."""
    if missing_modules := find_missing("nf4"):
        return f"{' and '.join(missing_modules)} not installed (`{install_line('nf4')}`): entries in NF4 do not load"
    import bitsandbytes
    import torch
    from bitsandbytes.nn.modules import Linear4bit

    layer = Linear4bit(64, 64, quant_type="nf4", compute_dtype=torch.float32)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    shape = tuple(layer.to(device)(torch.ones(1, 64, device=device)).shape)
    return f"bitsandbytes {bitsandbytes.__version__}: a layer of {shape[1]} in NF4 ran on {device}"


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
