"""`transformers serve` as a process: a server that nobody here wrote, started as its own command starts it.

The locked torch may be one without CUDA, beside which torchvision's wheel neither loads (`models.local.library`) nor
decodes a JPEG: there the server gets Pillow's decoder.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from tests.providers.servers import closed_port

START_S = 600


@contextmanager
def transformers_serve(checkpoint: Path, hub: Path) -> Iterator[str]:
    """The address at which a checkpoint's folder is served, under its path as the name. hub: an empty folder in the
    place of the user's cache of models."""
    port = str(closed_port())
    command = [sys.executable, "-m", "tests.serving", "serve", str(checkpoint), "--port", port, "--device", "cpu"]
    environment = os.environ | {"HF_HOME": str(hub), "HF_HUB_OFFLINE": "1"}
    with (hub / "serve.log").open("w") as log:
        server = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            until = time.monotonic() + START_S
            while not _answers(f"http://127.0.0.1:{port}/health"):
                said = (hub / "serve.log").read_text()[-2000:]
                assert server.poll() is None and time.monotonic() < until, f"transformers serve does not start:\n{said}"
                time.sleep(0.2)
            yield f"http://127.0.0.1:{port}/v1"
        finally:
            server.terminate()
            server.wait()


def _answers(address: str) -> bool:
    with suppress(OSError), urlopen(address, timeout=5) as answer:
        return answer.status == 200
    return False


def _lend_a_decoder() -> None:
    """Let torchvision decode images where its own decoder is linked against a CUDA that is not there."""
    import numpy as np
    import torch
    import torchvision.io
    from PIL import Image

    def decode(data: Any, mode: Any = None, apply_exif_orientation: bool = False) -> Any:
        with Image.open(io.BytesIO(bytes(data.numpy()))) as image:
            return torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1)

    try:
        torch.ops.image.decode_image  # noqa: B018 - raises where the library has not been loaded
    except AttributeError:
        torchvision.io.decode_image = decode


if __name__ == "__main__":
    from traps_pipeline.models.local.library import load_transformers

    load_transformers()
    _lend_a_decoder()
    import_module("transformers.cli.transformers").main()  # by name: for its types pyright reads 3,000 files
