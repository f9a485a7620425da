"""What errors about checkpoints say to do lets a model be loaded and asked; all on tiny checkpoints of real classes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.local_models import NF4_SKIP, ask, checkpoint, entry, model
from tests.remedies.remedied import remedied
from traps_pipeline.mechanism.adapter_checks import CHECKS
from traps_pipeline.models.local.adapter import load_local_model
from traps_pipeline.study.doctor import examine_local

pytestmark = pytest.mark.slow
LLAVA = {"processor_class": "LlavaProcessor"}  # of images alone


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint to be altered."""
    return Path(shutil.copytree(checkpoint("qwen3-vl"), tmp_path / "altered"))


def without_a_weight(folder: Path) -> None:
    tensors = load_file(folder / "model.safetensors")
    del tensors["model.language_model.layers.1.mlp.up_proj.weight"]
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})


def of_another_class(folder: Path) -> None:
    (folder / "config.json").write_text(json.dumps({"model_type": "bert", "architectures": ["BertModel"]}))


def with_code(folder: Path) -> None:
    said = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(said | {"model_type": "evil", "auto_map": {"AutoConfig": "evil.E"}}))


def saved_again(folder: Path) -> None:
    shutil.rmtree(folder)
    shutil.copytree(checkpoint("qwen3-vl"), folder)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (without_a_weight, "weights are not in its files, {} first, and would be random: download or save it again"),
        (
            lambda folder: (folder / "model.safetensors").write_bytes(b"no weights"),
            "no safetensors file ({}); download or save the checkpoint again",
        ),
        (lambda folder: (folder / "config.json").unlink(), "set checkpoint: to a folder saved by save_pretrained ({})"),
    ],
)
def test_a_checkpoint_that_is_saved_again_is_loaded(
    folder: Path, damage: Callable[[Path], object], sentence: str
) -> None:
    damage(folder)
    remedied(lambda: load_local_model(entry("qwen3-vl", folder)), sentence, lambda: saved_again(folder))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (of_another_class, "name a checkpoint of such a class, or save it again with this version"),
        (with_code, "name a checkpoint of a class that transformers has itself, or one that was saved again by such"),
    ],
)
def test_another_checkpoint_that_is_named_is_loaded(
    folder: Path, damage: Callable[[Path], object], sentence: str
) -> None:
    damage(folder)
    remedied(
        lambda: load_local_model(entry("qwen3-vl", folder)),
        sentence,
        again=lambda: load_local_model(entry("qwen3-vl", checkpoint("qwen3-vl"))),
    )


def test_weights_that_are_copied_here_are_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    remedied(
        lambda: load_local_model(entry("qwen3-vl", "nobody/nothing", revision="abc")),
        "or copy the weights here and set `checkpoint:` of the entry to their folder",
        again=lambda: load_local_model(entry("qwen3-vl", checkpoint("qwen3-vl"))),
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_model_runs_on_the_cpu_where_there_is_no_other_device() -> None:
    remedied(
        lambda: load_local_model(entry("qwen3-vl").model_copy(update={"device": "cuda"})),
        "run where there is one, or say `device: cpu` in the entry",
        again=lambda: load_local_model(entry("qwen3-vl").model_copy(update={"device": "cpu"})),
    )


def test_modules_too_narrow_for_four_bits_are_skipped_by_name() -> None:
    pytest.importorskip("bitsandbytes")
    remedied(
        lambda: model("qwen3-vl", quantisation="nf4"),
        "first, are not: name them, or what holds them, under nf4_skip beside the entry's quantisation: nf4",
        again=lambda: model("qwen3-vl", quantisation="nf4", nf4_skip=NF4_SKIP),
    )


def test_a_model_that_does_not_fit_is_loaded_once_memory_is_freed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as full:
        full.setattr("traps_pipeline.models.local.checkpoint.free_bytes", lambda device: 1000.0)
        remedied(
            lambda: load_local_model(entry("qwen3-vl", folder)),
            "free memory (another model of this run may hold it: ask one at a time), choose another device, or say",
            full.undo,
        )


def test_a_checkpoint_with_another_template_keeps_the_whole_prompt(folder: Path) -> None:
    template = folder / "chat_template.jinja"
    whole = template.read_text()
    template.write_text(whole.replace("in messages", "in messages[1:]"))
    remedied(
        lambda: ask(load_local_model(entry("qwen3-vl", folder))),
        "give `params.template` the variables it wants, or the checkpoint another template",
        lambda: template.write_text(whole),
    )


def test_a_checkpoint_that_says_how_an_answer_ends_answers(folder: Path) -> None:
    config = folder / "generation_config.json"
    said = json.loads(config.read_text()) | {"eos_token_id": model("qwen3-vl").processor.tokenizer.eos_token_id}
    for path in folder.glob("*.json"):
        text = json.loads(path.read_text())
        for part in (text, text.get("text_config", {})):
            for name in ("eos_token_id", "eos_token"):
                part.pop(name, None)
        path.write_text(json.dumps(text))

    def asked() -> object:
        of = load_local_model(entry("qwen3-vl", folder))
        return of.generate([ask(of)], 2)

    remedied(
        asked,
        "names no token that ends an answer; set eos_token_id in its generation_config.json",
        lambda: config.write_text(json.dumps(said)),
    )


def test_a_processor_that_takes_videos_is_named(folder: Path) -> None:
    (folder / "video_preprocessor_config.json").unlink(missing_ok=True)
    for path in folder.glob("*config.json"):
        said = json.loads(path.read_text())
        if "processor_class" in said:
            path.write_text(json.dumps({k: v for k, v in said.items() if k != "video_processor"} | LLAVA))
    remedied(
        lambda: load_local_model(entry("qwen3-vl", folder)),
        "checkpoint {}: {} takes no videos; name a model that does",
        again=lambda: load_local_model(entry("qwen3-vl", checkpoint("qwen3-vl"))),
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
        "models/local/checkpoint.py | run `{}` again to complete it",
        lambda: shutil.copy(checkpoint("qwen3-vl") / "model.safetensors", snapshot),
    )


def test_a_prompt_that_does_not_fit_is_answered_once_memory_is_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    of = model("qwen3-vl")

    def full(*_: object) -> None:
        raise torch.OutOfMemoryError

    with monkeypatch.context() as memory:
        memory.setattr(of, "_one_batch", full)
        (answer,) = remedied(
            lambda: of.generate([ask(of)], 2),
            "new ones: free memory, show fewer frames or use a larger device",
            memory.undo,
        )
    assert answer.tokens


def test_a_model_that_runs_here_is_looked_into() -> None:
    findings = remedied(
        lambda: [*examine_local(["gpt-5-mini"])],
        "{}: runs elsewhere, so nobody looks into it; name one of {}",
        again=lambda: [*examine_local(["pocket"])],
    )
    assert all(finding.ok for finding in findings if finding.what.startswith("pocket, ")), findings
    assert len([finding for finding in findings if finding.what.startswith("pocket, ")]) == len(CHECKS)
