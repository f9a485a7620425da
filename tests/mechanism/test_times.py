"""Times of a class that takes one number for them: Qwen2.5-VL computes it from the number of frames of the clip."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.build.errors import raises
from tools.tiny_checkpoints import make_tokenizer
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.adapter_checks import CHECKS, Subject
from traps_pipeline.models.local import model as local_model
from traps_pipeline.models.local.adapter import LocalModel, load_local_model
from traps_pipeline.models.local.library import load_transformers
from traps_pipeline.models.registry.entries import ModelEntry
from traps_pipeline.storage.media import MediaSpec

pytestmark = pytest.mark.slow
TEXT = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
TEXT |= {"num_key_value_heads": 2, "rope_parameters": {"rope_type": "default", "rope_theta": 1e4}}
TEXT["rope_parameters"] |= {"mrope_section": [1, 1, 2]}
VISION = {"depth": 1, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2, "out_hidden_size": 32}
VISION |= {"fullatt_block_indexes": [0], "window_size": 56}
CHAT = (
    "{%- for m in messages %}{{ m['role'] }} {% for p in m['content'] %}"
    "{%- if p['type'] == 'video' %}<|vision_start|><|video_pad|><|vision_end|>{% else %}{{ p['text'] }}{% endif %}"
    "{%- endfor %}\n{% endfor %}"
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> LocalModel:
    """Return a tiny random Qwen2.5-VL, whose tower merges two frames."""
    transformers, folder = load_transformers(), tmp_path_factory.mktemp("qwen25") / "tiny"
    tokenizer = make_tokenizer("qwen3-vl")
    ids = {f"{name}_token_id": tokenizer.convert_tokens_to_ids(f"<|{name}_pad|>") for name in ("image", "video")}
    ids["vision_start_token_id"] = tokenizer.convert_tokens_to_ids("<|vision_start|>")
    text = TEXT | {"vocab_size": len(tokenizer), "eos_token_id": tokenizer.eos_token_id}
    config = transformers.Qwen2_5_VLConfig(text_config=text, vision_config=VISION, **ids)
    torch.manual_seed(0)
    transformers.AutoModelForImageTextToText.from_config(config).save_pretrained(folder)
    video = transformers.Qwen2VLVideoProcessor(size={"shortest_edge": 28 * 28, "longest_edge": 2 * 56 * 56})
    processor = transformers.Qwen2_5_VLProcessor(
        image_processor=transformers.Qwen2VLImageProcessor(), tokenizer=tokenizer, video_processor=video,
        chat_template=CHAT,
    )  # fmt: skip
    processor.save_pretrained(folder)
    params = {"checkpoint": str(folder), "dtype": "float32", "quantisation": "none"}
    params |= {"do_sample": False, "max_new_tokens": 2}
    media = MediaSpec(profile="frames", uniform=4)
    return load_local_model(ModelEntry(id="tiny", backend="local", device="cpu", media=media, params=params))


def clip(times_s: np.ndarray) -> np.ndarray:
    return np.stack([np.full((56, 56, 3), shade, np.uint8) for shade in np.linspace(20, 220, len(times_s))])


@pytest.mark.parametrize(
    ("times_s", "seconds"),
    [([0.0, 0.5, 1.0, 1.5], 1.0), ([0.0, 1.0], 2.0), ([2.0, 2.25, 2.5, 2.75, 3.0, 3.25], 0.5)],
)
def test_a_step_of_positions_is_as_long_as_the_frames_that_it_stands_for(
    model: LocalModel, times_s: list[float], seconds: float
) -> None:
    times = np.array(times_s)
    prompt = model.prompt("Look.", "Which?", clip(times), times)
    assert float(prompt.inputs["second_per_grid_ts"]) == pytest.approx(seconds)


def test_a_clock_that_ends_at_the_last_frame_is_refused(model: LocalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """The spacing is then a share (N - 1) / N of the frames': .75 of it for four."""
    (check,) = (check for check in CHECKS if check.name == "times")
    times = np.arange(4) / 2
    subject = Subject(model, clip(times), times)
    assert check.found(subject).startswith("second_per_grid_ts")
    with monkeypatch.context() as patch:
        patch.setattr(local_model, "shown_frames", lambda marks: marks[-1] + 1)
        with raises(TrapsError, "mechanism.adapter_checks._require"):
            check.found(Subject(model, clip(times), times))
