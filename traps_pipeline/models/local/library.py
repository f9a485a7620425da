"""Load torch and transformers, quietly and in the right order, only here."""

import ctypes
import logging
import os
import warnings
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from traps_pipeline.base.extras import require_extra


@cache
def load_transformers() -> Any:
    """Return transformers, set to send nothing. Raises TrapsError if not installed."""
    require_extra("local")
    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")  # tokenizer threads would warn at every fork
    _declare_torchvision_operators()
    transformers: Any = import_module("transformers")
    transformers.logging.set_verbosity_error()
    transformers.logging.disable_progress_bar()
    logging.getLogger("bitsandbytes").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="bitsandbytes")
    return transformers


@cache
def _declare_torchvision_operators() -> None:
    """Declare operators that torchvision looks up at import: its library of CUDA does not load beside a CPU torch."""
    library = _torchvision_library()
    if library is None:
        return
    torch: Any = import_module("torch")
    try:
        ctypes.CDLL(str(library))  # defines the operators itself
    except OSError:
        operator_library = torch.library.Library("torchvision", "DEF")
        operator_library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        operator_library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _KEPT.append(operator_library)  # they are removed with the object


_KEPT: list[Any] = []


def _torchvision_library() -> Path | None:
    """Return the path of torchvision's library, if any, without importing it."""
    spec = find_spec("torchvision")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    return next((path for folder in folders for path in Path(folder).glob("_C*.so")), None)
