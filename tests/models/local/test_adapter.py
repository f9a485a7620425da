"""One adapter for three families, on real classes: nothing that is asked for is lost, and batches change no answer."""

from __future__ import annotations

import json
import re
import shutil
import weakref
from collections import Counter, OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.build.errors import raises
from tests.local_models import (
    FAMILIES,
    NF4_SKIP,
    QUESTIONS,
    SYSTEM,
    Family,
    ask,
    checkpoint,
    direction,
    entry,
    model,
    three_prompts,
)
from tools.tiny_checkpoints import build_tiny, make_tokenizer
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.hook import Steering
from traps_pipeline.mechanism.probing_versions import loaded_params
from traps_pipeline.models.local import adapter
from traps_pipeline.models.local.adapter import Sampling, load_local_model
from traps_pipeline.models.local.decoding import decode
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.local.prompt_batches import prompt_batches
from traps_pipeline.models.local.sampling import SeededNucleus
from traps_pipeline.models.registry.checkpoint import weight_bytes
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.models.registry.local_settings import MechanismSpec

pytestmark = pytest.mark.slow

CLASSES = {
    "qwen3-vl": "Qwen3VLForConditionalGeneration",
    "gemma-4": "Gemma4ForConditionalGeneration",
    "llava-next-video": "LlavaNextVideoForConditionalGeneration",
}
each_family = pytest.mark.parametrize("family", FAMILIES)


def tokens(answers: list[adapter.GeneratedAnswer]) -> list[tuple[int, ...]]:
    return [answer.tokens for answer in answers]


@each_family
def test_a_saved_checkpoint_reloads_through_the_auto_classes_and_answers_a_real_clip(family: Family) -> None:
    transformers = load_transformers()
    folder = checkpoint(family)
    assert sum(file.stat().st_size for file in folder.iterdir()) < 2.1e6
    assert type(transformers.AutoModelForImageTextToText.from_pretrained(folder)).__name__ == CLASSES[family]
    of = model(family)
    blocks = 6 if family == "gemma-4" else 4  # of which two read keys and values of two others
    assert (type(of.network).__name__, of.n_layers, of.d_model) == (CLASSES[family], blocks, 64)
    (answer,) = of.generate([ask(of)], 8)
    assert (answer.prompt_tokens, answer.completion_tokens) == (ask(of).n_tokens, len(answer.tokens))
    assert answer.finish_reason == ("length" if answer.completion_tokens == 8 else "stop")
    assert answer.text == of.processor.tokenizer.decode(answer.tokens, skip_special_tokens=True)
    other = ask(of).inputs | {name: 1 - value for name, value in ask(of).inputs.items() if value.is_floating_point()}
    seen, inverted = of.forward_states(ask(of)), of.forward_states(replace(ask(of), inputs=other))
    assert np.abs(seen.raw[-1] - inverted.raw[-1]).max() > 1e-3  # what is in the picture reaches the last token


def test_time_stamps_are_those_of_the_frames() -> None:
    qwen, gemma = model("qwen3-vl"), model("gemma-4")  # LLaVA reads none
    frames = np.zeros((5, 64, 64, 3), np.uint8)
    times = [0.0, 0.4, 61.0, 61.3, 125.7]
    text = qwen.processor.tokenizer.decode(qwen.prompt(SYSTEM, "Q?", frames, times).inputs["input_ids"][0])
    assert re.findall(r"<([\d.]+) seconds>", text) == ["0.2", "61.1", "125.7"]  # of two frames a slot, the mean
    text = gemma.processor.tokenizer.decode(gemma.prompt(SYSTEM, "Q?", frames, times).inputs["input_ids"][0])
    assert re.findall(r"\d\d:\d\d", text) == ["00:00", "00:00", "01:01", "01:01", "02:05"]


def test_every_frame_is_shown_and_none_is_sampled_again() -> None:
    for n in (5, 6):
        assert ask(model("llava-next-video"), frames=n).inputs["pixel_values_videos"].shape[1] == n
        assert ask(model("gemma-4"), frames=n).inputs["num_frames_per_video"].tolist() == [n]
        assert ask(model("qwen3-vl"), frames=n).inputs["video_grid_thw"][0, 0] == 3  # two frames a slot


@each_family
def test_neither_the_cache_nor_a_batch_nor_padding_changes_an_answer(
    family: Family, monkeypatch: pytest.MonkeyPatch
) -> None:
    of, prompts = model(family), three_prompts(family)
    assert len({prompt.n_tokens for prompt in prompts}) == 3
    together = tokens(of.generate(prompts, 10))
    assert together == [tokens(of.generate([prompt], 10))[0] for prompt in prompts]
    assert len(set(together)) > 1
    monkeypatch.setattr(of.network.generation_config, "use_cache", False)
    assert together == tokens(of.generate(prompts, 10))


def test_a_sampled_answer_depends_on_its_seed_and_not_on_its_batch() -> None:
    of, prompts = model("gemma-4"), three_prompts("gemma-4")
    sampled = tokens(of.generate(prompts, 10, Sampling(0.8, 0.95, (1, 2, 3))))
    assert sampled[1:] == tokens(of.generate(prompts[1:], 10, Sampling(0.8, 0.95, (2, 3))))
    again = tokens(of.generate([prompts[0]] * 3, 10, Sampling(0.8, 0.95, (1, 1, 2))))
    assert again[0] == again[1] == sampled[0] != again[2]


def test_the_nucleus_is_drawn_from_with_its_own_shares() -> None:
    probabilities = np.array([0.1, 0.5, 0.15, 0.25])
    rows = 4000
    scores = torch.tensor(np.log(probabilities), dtype=torch.float32).expand(rows, 4).clone()

    def drawn(temperature: float, top_p: float) -> np.ndarray:
        chosen = SeededNucleus(Sampling(temperature, top_p, range(rows)))(None, scores).argmax(dim=-1)
        return np.bincount(chosen.numpy(), minlength=4) / rows

    within = pytest.approx
    assert drawn(1.0, 1.0) == within(probabilities, abs=0.025)  # three standard errors of a share of 0.5
    assert drawn(1.0, 0.6) == within(np.array([0, 2, 0, 1]) / 3, abs=0.025)  # 0.5 alone does not reach 0.6
    assert drawn(1.0, 0.5) == within(np.array([0, 1, 0, 0]))
    assert drawn(0.5, 1.0) == within(probabilities**2 / (probabilities**2).sum(), abs=0.025)


def test_prompts_with_other_numbers_of_frames_are_answered_in_order_all_the_same() -> None:
    of = model("llava-next-video")
    prompts = [ask(of, frames=6), ask(of, frames=4), ask(of, frames=6), ask(of, QUESTIONS[1], frames=4)]
    assert tokens(of.generate(prompts, 6)) == [tokens(of.generate([prompt], 6))[0] for prompt in prompts]


def test_batches_hold_what_fits_and_at_least_one() -> None:
    prompts = three_prompts("qwen3-vl")  # the longest is the second
    assert list(prompt_batches(prompts, [10.0, 10.0, 10.0], 20.0)) == [[2, 0], [1]]
    assert list(prompt_batches(prompts, [10.0, 10.0, 10.0], 5.0)) == [[2], [0], [1]]
    assert list(prompt_batches(prompts, [10.0, 10.0, 10.0], 1e9)) == [[2, 0, 1]]


def test_a_batch_that_does_not_fit_is_halved_and_answers_stay_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    of, prompts = model("qwen3-vl"), three_prompts("qwen3-vl")
    expected = tokens(of.generate(prompts, 6))
    sizes: list[int] = []
    most = 1

    def small(of: Any, rows: Any, *rest: Any) -> Any:
        sizes.append(len(rows))
        if len(rows) > most:
            raise torch.OutOfMemoryError
        return decode(of, rows, *rest)

    monkeypatch.setattr("traps_pipeline.models.local.model.decode", small)
    assert tokens(of.generate(prompts, 6)) == expected
    assert Counter(sizes) == {3: 1, 1: 3, 2: 1}
    most = 0
    named = "cpu", str(prompts[0].n_tokens)
    with raises(TrapsError, "models.local.model.LocalModel._generate_fitting", *named):
        of.generate(prompts[:1], 6)


def test_generation_ends_when_it_is_told_to() -> None:
    of = model("qwen3-vl")
    asked = iter([False, False, True])
    (answer,) = of.generate([ask(of)], 8, stopped=lambda: next(asked))
    assert len(answer.tokens) == 3


def test_a_checkpoints_own_sampling_is_not_applied_unasked(tmp_path: Path) -> None:
    folder = tmp_path / "own"
    shutil.copytree(checkpoint("qwen3-vl"), folder)
    config = json.loads((folder / "generation_config.json").read_text())
    config |= {"do_sample": True, "top_k": 1, "temperature": 0.01, "repetition_penalty": 5.0, "suppress_tokens": [5]}
    (folder / "generation_config.json").write_text(json.dumps(config))
    of = load_local_model(entry("qwen3-vl", folder))
    assert tokens(of.generate([ask(of)], 8)) == tokens(model("qwen3-vl").generate([ask(of)], 8))
    assert 5 in of.network.generation_config.suppress_tokens


# --- NF4 --------------------------------------------------------------------------------------------------------------


@each_family
def test_in_four_bits_it_loads_extracts_and_is_steered(family: Family) -> None:
    pytest.importorskip("bitsandbytes")
    whole, of = model(family), model(family, quantisation="nf4", nf4_skip=NF4_SKIP)
    kinds = Counter(type(module).__name__ for module in of.blocks.modules())
    assert kinds["Linear4bit"] >= 24
    assert not any(type(module).__name__ == "Linear4bit" for module in whole.network.modules())
    prompt = ask(of)
    exact, states = whole.forward_states(prompt).raw, of.forward_states(prompt).raw
    cosines = (exact * states).sum(axis=1) / np.linalg.norm(exact, axis=1) / np.linalg.norm(states, axis=1)
    assert cosines[0] == pytest.approx(1)
    assert (cosines[1:] < 0.9999).all()
    assert cosines[1] > 0.85  # one block of random weights away; further on they amplify the difference
    push = Steering(direction(of), 2, (50.0,))
    assert (of.forward_states(prompt, steering=push).raw[2] == states[2] + np.float32(50) * direction(of)).all()
    assert tokens(of.generate([prompt], 6, steering=push)) != tokens(of.generate([prompt], 6))
    assert of.identity != whole.identity
    assert "nf4/float32 on cpu" in of.served_model


def test_what_answers_whole_can_be_looked_into_in_four_bits_but_for_some_modules() -> None:
    pytest.importorskip("bitsandbytes")

    def with_skip(*skipped: str) -> ModelEntry:
        spec = MechanismSpec(quantisation="nf4", nf4_skip=skipped)
        return entry("qwen3-vl").model_copy(update={"mechanism": spec})

    of = with_skip(*NF4_SKIP)
    inside, answering = load_local_model(of, inside=True), load_local_model(of)
    assert inside.identity["nf4_skip"] == NF4_SKIP
    four_bits = [name for name, m in inside.network.named_modules() if type(m).__name__ == "Linear4bit"]
    assert four_bits and not [name for name in four_bits if "visual" in name]
    assert answering.quantisation == "none"
    assert loaded_params(of)["nf4_skip"] == NF4_SKIP  # so it is in keys of steered answers and versions of states
    assert "nf4_skip" not in loaded_params(with_skip()) and loaded_params(with_skip())["quantisation"] == "nf4"
    too_narrow = "model.visual.blocks.0.attn.qkv", "nf4_skip", "params", "mechanism"
    with raises(TrapsError, "models.local.adapter._require_packable", *too_narrow):
        load_local_model(with_skip(), inside=True)


# --- checkpoints ------------------------------------------------------------------------------------------------------


def test_what_weights_take_is_read_off_their_files() -> None:
    folder = checkpoint("qwen3-vl")
    numbers = sum(tensor.numel() for tensor in load_file(folder / "model.safetensors").values())
    assert weight_bytes(folder, "float32", "none") == 4 * numbers
    assert weight_bytes(folder, "bfloat16", "none") == 2 * numbers


def altered(tmp_path: Path, family: Family = "qwen3-vl") -> Path:
    return Path(shutil.copytree(checkpoint(family), tmp_path / "altered"))


def test_weights_that_are_not_here_say_how_to_get_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    download = "`hf download nobody/nothing --revision abc`"
    with raises(TrapsError, "models.registry.checkpoint.find_checkpoint", download, "`checkpoint:`"):
        load_local_model(entry("qwen3-vl", "nobody/nothing", revision="abc"))
    gone = tmp_path / "nowhere" / "config.json"
    with raises(TrapsError, "models.registry.checkpoint._require_whole", str(gone), "save_pretrained"):
        load_local_model(entry("qwen3-vl", gone.parent))


def test_a_shard_that_is_missing_is_named(tmp_path: Path) -> None:
    folder = altered(tmp_path)
    (folder / "model.safetensors").unlink()
    index = {"weight_map": {"a": "model-1-of-2.safetensors", "b": "model-2-of-2.safetensors"}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    with raises(TrapsError, "models.registry.checkpoint._require_whole", str(folder / "model-1-of-2.safetensors")):
        load_local_model(entry("qwen3-vl", folder))


def test_a_weight_that_is_missing_is_never_left_random(tmp_path: Path) -> None:
    folder = altered(tmp_path)
    tensors = load_file(folder / "model.safetensors")
    del tensors["model.language_model.layers.1.mlp.up_proj.weight"]
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with raises(TrapsError, "models.local.adapter._load", str(folder), "layers.1.mlp.up_proj.weight"):
        load_local_model(entry("qwen3-vl", folder))


def test_a_checkpoint_of_another_kind_is_refused(tmp_path: Path) -> None:
    folder = altered(tmp_path)
    (folder / "config.json").write_text(json.dumps({"model_type": "bert", "architectures": ["BertModel"]}))
    with raises(TrapsError, "models.local.adapter._load", str(folder), load_transformers().__version__):
        load_local_model(entry("qwen3-vl", folder))


@pytest.mark.parametrize(
    ("kind", "named"),
    [("SmolVLMProcessor", ("num2words", "pip install")), ("InternVLProcessor", ("start_image_token",))],
)
def test_a_processor_that_wants_a_package_or_a_token_that_is_not_there_is_refused_by_that_name(
    tmp_path: Path, kind: str, named: tuple[str, ...]
) -> None:
    folder = altered(tmp_path)
    for name in ("processor_config.json", "tokenizer_config.json", "video_preprocessor_config.json"):
        if (folder / name).is_file():
            config = json.loads((folder / name).read_text()) | {"processor_class": kind}
            (folder / name).write_text(json.dumps(config))
    with raises(TrapsError, "models.local.adapter._load", str(folder), *named):
        load_local_model(entry("qwen3-vl", folder))


def test_too_little_memory_says_how_much_is_needed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = build_tiny("llava-next-video", tmp_path / "big", seed=5)
    monkeypatch.setattr("traps_pipeline.models.registry.checkpoint.free_bytes", lambda device: 1000.0)
    with raises(TrapsError, "models.registry.checkpoint.require_memory", str(folder), "0.0 GB", "float32", "cpu"):
        load_local_model(entry("llava-next-video", folder))


def test_a_model_is_unloaded_where_another_one_needs_its_memory_and_loaded_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The memory is as large as one network, and free once the first one is really gone."""
    monkeypatch.setattr(adapter, "_LOADED", OrderedDict())
    entries = [entry("qwen3-vl", build_tiny("qwen3-vl", tmp_path / str(seed), seed=seed)) for seed in (7, 8)]
    answer = load_local_model(entries[0]).generate([ask(load_local_model(entries[0]))], 4)[0].tokens
    held = weakref.ref(load_local_model(entries[0]).network)
    monkeypatch.setattr(adapter, "free_bytes", lambda device: 0.0 if held() is not None else 1e12)
    other = load_local_model(entries[1])
    assert held() is None and load_local_model(entries[1]) is other
    held = weakref.ref(other.network)
    del other
    again = load_local_model(entries[0])
    assert held() is None and again.generate([ask(again)], 4)[0].tokens == answer


def test_a_model_that_is_spread_over_devices_gives_the_states_and_answers_of_one_device() -> None:
    of = load_local_model(entry("gemma-4").model_copy(update={"device": "auto"}))
    one, push = model("gemma-4"), Steering(direction(of), 2, (60.0,))
    assert of is not one and of.inputs_device == ("cuda:0" if torch.cuda.is_available() else "cpu")
    if not torch.cuda.is_available():
        assert (of.forward_states(ask(of)).raw == one.forward_states(ask(one)).raw).all()
    assert of.generate([ask(of)], 8, steering=push)[0].tokens == one.generate([ask(one)], 8, steering=push)[0].tokens


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_here_is_never_replaced() -> None:
    with raises(TrapsError, "models.local.adapter.require_device", "cuda", f"torch {torch.__version__}"):
        load_local_model(entry("qwen3-vl").model_copy(update={"device": "cuda"}))


def test_a_chat_template_that_loses_the_system_prompt_is_refused(tmp_path: Path) -> None:
    folder = altered(tmp_path)
    template = (folder / "chat_template.jinja").read_text()
    (folder / "chat_template.jinja").write_text(template.replace("in messages", "in messages[1:]"))
    of = load_local_model(entry("qwen3-vl", folder))
    with raises(TrapsError, "models.local.model.LocalModel._render", str(folder), "`params.template`"):
        ask(of)


# --- a fourth class ---------------------------------------------------------------------------------------------------


def qwen2_5_vl(folder: Path) -> Path:
    """A tiny checkpoint of a class that nothing in the package names."""
    transformers = load_transformers()
    tokenizer = make_tokenizer("qwen3-vl")
    marks = {"image": "<|image_pad|>", "video": "<|video_pad|>", "vision_start": "<|vision_start|>"}
    text = {"vocab_size": len(tokenizer), "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 3}
    text |= {"num_attention_heads": 4, "num_key_value_heads": 2, "max_position_embeddings": 4096}
    text |= {"rope_parameters": {"rope_type": "default", "rope_theta": 1e4, "mrope_section": [4, 2, 2]}}
    text |= {"eos_token_id": tokenizer.eos_token_id, "initializer_range": 0.2}
    vision = {"depth": 2, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2, "out_hidden_size": 64}
    config = transformers.Qwen2_5_VLConfig(
        text_config=text,
        vision_config=vision | {"fullatt_block_indexes": [1], "window_size": 56},
        **{f"{name}_token_id": tokenizer.convert_tokens_to_ids(mark) for name, mark in marks.items()},
    )
    torch.manual_seed(0)
    transformers.AutoModelForImageTextToText.from_config(config).save_pretrained(folder)
    size = {"shortest_edge": 28 * 28, "longest_edge": 16 * 28 * 28}
    transformers.Qwen2_5_VLProcessor(
        image_processor=transformers.Qwen2VLImageProcessor(),
        tokenizer=tokenizer,
        video_processor=transformers.Qwen2VLVideoProcessor(size=size),
        chat_template=model("qwen3-vl").processor.chat_template,
    ).save_pretrained(folder)
    return folder


def test_another_model_of_the_library_is_one_entry_and_no_code(tmp_path: Path) -> None:
    of = load_local_model(entry("qwen3-vl", qwen2_5_vl(tmp_path)))
    assert type(of.network).__name__ == "Qwen2_5_VLForConditionalGeneration"
    prompts = [ask(of, question) for question in QUESTIONS]
    together = tokens(of.generate(prompts, 8))
    assert together == [tokens(of.generate([prompt], 8))[0] for prompt in prompts]
    states = of.forward_states(prompts[0])
    assert states.raw.shape == (4, 64)
    v = direction(of)
    steered = of.forward_states(prompts[0], steering=Steering(v, 2, (9.0,)))
    assert (steered.raw[2] == states.raw[2] + np.float32(9) * v).all()


@pytest.mark.parametrize(
    "file", ["config.json", "tokenizer_config.json", "processor_config.json", "video_preprocessor_config.json", "all"]
)
def test_code_in_a_checkpoint_never_runs_and_nobody_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    """One file names classes of code that lies elsewhere; or all do, and their code lies beside them."""
    folder, canary, asked = altered(tmp_path), tmp_path / "canary", list[str]()
    code, named = (tmp_path / "elsewhere", ["auto_map", file])
    if file == "all":
        code, named = folder, ["custom_generate/generate.py"]
    (code / "custom_generate").mkdir(parents=True)
    for module in ("evil.py", "custom_generate/generate.py"):
        (code / module).write_text(f"from pathlib import Path\nPath({str(canary)!r}).touch()\nclass Evil:\n    pass\n")
    evil = "evil.Evil" if code == folder else f"{code}--evil.Evil"
    auto = ("AutoConfig", "AutoTokenizer", "AutoProcessor", "AutoVideoProcessor", "AutoImageProcessor")
    classes: dict[str, Any] = dict.fromkeys((*auto, "AutoModelForImageTextToText", "AutoModel"), evil)
    classes["AutoTokenizer"] = [evil, evil]
    for path in folder.glob("*config.json") if file == "all" else [folder / file]:
        said = json.loads(path.read_text()) if path.exists() else {}
        said |= {"auto_map": classes, "model_type": "evil", "architectures": ["Evil"]}
        said |= {"tokenizer_class": "Evil", "processor_class": "Evil", "video_processor_type": "Evil"}
        path.write_text(json.dumps(said))
    monkeypatch.setattr("builtins.input", lambda question="": asked.append(question) or "y")
    with raises(TrapsError, "models.registry.checkpoint.require_no_code", str(folder), *named):
        load_local_model(entry("qwen3-vl", folder))
    assert asked == [] and not canary.exists()
