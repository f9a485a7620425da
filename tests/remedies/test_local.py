"""What errors about checkpoints say to do lets a model be loaded and asked; all on tiny checkpoints of real classes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.local_models import ask, checkpoint, entry, model
from tests.remedies.remedied import remedied
from traps_pipeline.models.local.adapter import load_local_model

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint to be altered."""
    return Path(shutil.copytree(checkpoint("qwen3-vl"), tmp_path / "altered"))


def without_a_weight(folder: Path) -> None:
    tensors = load_file(folder / "model.safetensors")
    del tensors["model.language_model.layers.1.mlp.up_proj.weight"]
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})


def saved_again(folder: Path) -> None:
    shutil.rmtree(folder)
    shutil.copytree(checkpoint("qwen3-vl"), folder)


@pytest.mark.parametrize(
    ("damage", "by"),
    [
        (without_a_weight, "models.local.adapter"),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"no weights"), "models.local.checkpoint"),
        (lambda folder: (folder / "config.json").unlink(), "models.local.checkpoint"),
    ],
)
def test_a_checkpoint_that_is_saved_again_is_loaded(folder: Path, damage: Callable[[Path], object], by: str) -> None:
    damage(folder)
    remedied(lambda: load_local_model(entry("qwen3-vl", folder)), by, lambda: saved_again(folder))


def test_a_model_that_does_not_fit_is_loaded_once_memory_is_freed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as full:
        full.setattr("traps_pipeline.models.local.checkpoint.free_bytes", lambda device: 1000.0)
        remedied(
            lambda: load_local_model(entry("qwen3-vl", folder)), "models.local.checkpoint.require_memory", full.undo
        )


def test_a_download_that_is_completed_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hub's cache as it is laid out on a disk; what a second download would bring is put there by hand."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    repository, commit = tmp_path / "models--nobody--nothing", "0" * 40
    snapshot = repository / "snapshots" / commit
    shutil.copytree(checkpoint("qwen3-vl"), snapshot)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    (snapshot / "model.safetensors").unlink()
    remedied(
        lambda: load_local_model(entry("qwen3-vl", "nobody/nothing")),
        "models.local.checkpoint",
        lambda: shutil.copy(checkpoint("qwen3-vl") / "model.safetensors", snapshot),
    )


def test_a_prompt_that_does_not_fit_is_answered_once_memory_is_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    of = model("qwen3-vl")

    def full(*_: object) -> None:
        raise torch.OutOfMemoryError

    with monkeypatch.context() as memory:
        memory.setattr(of, "_one_batch", full)
        (answer,) = remedied(lambda: of.generate([ask(of)], 2), "models.local.model", memory.undo)
    assert answer.tokens
