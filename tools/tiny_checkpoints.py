"""Build tiny random checkpoints of the real classes, without downloads.

Tokenizer, chat template and processor are made here. They serve tests and benchmarks. With larger sizes and
a tokenizer of its own, one is the skeleton of a model that is trained from scratch.

    build_tiny("qwen3-vl", folder)                       # 1 to 2 MB, bytes as tokens
    build_tiny("qwen3-vl", folder, text={"hidden_size": 128, "num_hidden_layers": 8}, tokenizer=word_level)

The folder loads with `AutoProcessor` and `AutoModelForImageTextToText`, and as `checkpoint:` of an entry.
`make_config`, `make_tokenizer` and `make_processor` give the parts to who trains: they build what `build_tiny` saves.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from traps_pipeline.models.local.library import load_transformers

if TYPE_CHECKING:
    from tokenizers import Tokenizer

Family = Literal["qwen3-vl", "gemma-4", "llava-next-video"]
FAMILIES: tuple[Family, ...] = get_args(Family)
Overrides = Mapping[str, Any]

_HEADS = {"num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 16}
_TEXT: dict[str, Any] = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 4, **_HEADS}
# Standard deviation of a random checkpoint's text weights, large enough for every prompt token to affect the answer.
_WEIGHT_STD: dict[Family, float] = {"qwen3-vl": 0.2, "gemma-4": 0.02, "llava-next-video": 0.2}
_VISION_SIZE = 32  # hidden size of the vision towers
_STILL_PIXELS = 128 * 96  # pixels of an image: those of the pocket model's training frames

# Special tokens by the name under which the family's processor looks them up; `pad` and `eos` are in all of them.
_SPECIAL: dict[Family, dict[str, str]] = {
    "qwen3-vl": {
        "pad": "<|endoftext|>",
        "eos": "<|im_end|>",
        "start": "<|im_start|>",
        "vision_start": "<|vision_start|>",
        "vision_end": "<|vision_end|>",
        "image": "<|image_pad|>",
        "video": "<|video_pad|>",
    },
    "gemma-4": {
        "pad": "<pad>",
        "eos": "<turn|>",
        "bos": "<bos>",
        "start": "<|turn>",
        "image": "<|image|>",
        "boi": "<|image>",
        "eoi": "<image|>",
        "audio": "<|audio|>",
        "boa": "<|audio>",
        "eoa": "<audio|>",
        "video": "<|video|>",
    },
    "llava-next-video": {"pad": "<pad>", "eos": "</s>", "bos": "<s>", "image": "<image>", "video": "<video>"},
}

# Like the families' own: system, then the clip, then the question, and the beginning of an answer.
_PARTS = "{%- for part in message['content'] -%}"
_TEMPLATES: dict[Family, str] = {
    "qwen3-vl": (
        "{%- for message in messages -%}{{ '<|im_start|>' + message['role'] + '\n' }}" + _PARTS + "{%- if "
        "part['type'] == 'video' -%}{{ '<|vision_start|><|video_pad|><|vision_end|>' }}{%- elif "
        "part['type'] == 'image' -%}{{ '<|vision_start|><|image_pad|><|vision_end|>' }}{%- else -%}{{ part['text'] }}"
        "{%- endif -%}{%- endfor -%}{{ '<|im_end|>\n' }}{%- endfor -%}"
        "{%- if add_generation_prompt -%}{{ '<|im_start|>assistant\n' }}{%- endif -%}"
    ),
    "gemma-4": (
        "{{ '<bos>' }}{%- for message in messages -%}{{ '<|turn>' + message['role'] + '\n' }}" + _PARTS + "{%- if "
        "part['type'] == 'video' -%}{{ '\n\n<|video|>\n\n' }}{%- else -%}{{ part['text'] | trim }}{%- endif -%}"
        "{%- endfor -%}{{ '<turn|>\n' }}{%- endfor -%}"
        "{%- if add_generation_prompt -%}{{ '<|turn>model\n' }}{%- endif -%}"
    ),
    "llava-next-video": (
        "{%- for message in messages -%}{%- if message['role'] != 'system' -%}{{ message['role'].upper() + ': ' }}"
        "{%- endif -%}" + _PARTS + "{%- if part['type'] == 'video' -%}{{ '<video>\n' }}{%- else -%}"
        "{{ part['text'] + ' ' }}{%- endif -%}{%- endfor -%}{%- endfor -%}"
        "{%- if add_generation_prompt -%}{{ 'ASSISTANT:' }}{%- endif -%}"
    ),
}


def build_tiny(
    family: Family,
    folder: Path,
    seed: int = 0,
    *,
    tokenizer: Tokenizer | None = None,
    text: Overrides | None = None,
    vision: Overrides | None = None,
    video: Overrides | None = None,
) -> Path:
    """Write a random checkpoint of the family's real class and return its folder.

    tokenizer: of the `tokenizers` library, instead of bytes; the family's special tokens are added to it. text, vision:
    fields of the two configurations. video: fields of the video processor. The same arguments give the same weights.
    """
    import torch

    transformers = load_transformers()
    fast_tokenizer = make_tokenizer(family, tokenizer)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        config = make_config(family, fast_tokenizer, {"initializer_range": _WEIGHT_STD[family], **(text or {})}, vision)
        model = transformers.AutoModelForImageTextToText.from_config(config)
    model.generation_config.eos_token_id = fast_tokenizer.eos_token_id
    model.generation_config.pad_token_id = fast_tokenizer.pad_token_id
    model.save_pretrained(folder)
    make_processor(family, fast_tokenizer, video).save_pretrained(folder)
    return folder


def make_tokenizer(family: Family, tokenizer: Tokenizer | None = None) -> Any:
    """Return a tokenizer (default: bytes) with the family's special tokens added."""
    transformers = load_transformers()
    special = _SPECIAL[family]
    base = _byte_level() if tokenizer is None else tokenizer
    special_tokens = {f"{name}_token": token for name, token in special.items()}
    main_tokens = {
        name: special_tokens.pop(name) for name in ("pad_token", "eos_token", "bos_token") if name in special_tokens
    }
    fast_tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=base,
        padding_side="left",
        extra_special_tokens=special_tokens,
        clean_up_tokenization_spaces=False,
        **main_tokens,
    )
    if "bos" in special:  # as the families' own tokenizers do, whether or not the chat template writes it too
        from tokenizers.processors import TemplateProcessing

        bos = special["bos"]
        fast_tokenizer.backend_tokenizer.post_processor = TemplateProcessing(
            single=f"{bos} $A", special_tokens=[(bos, fast_tokenizer.bos_token_id)]
        )
    return fast_tokenizer


def _byte_level() -> Tokenizer:
    """Return a tokenizer with one token per byte, which can read and write any text."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers

    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    tokenizer = Tokenizer(models.BPE(vocab={character: i for i, character in enumerate(alphabet)}, merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)  # pyright: ignore[reportAttributeAccessIssue]
    tokenizer.decoder = decoders.ByteLevel()  # pyright: ignore[reportAttributeAccessIssue]
    return tokenizer


def make_config(family: Family, tokenizer: Any, text: Overrides | None = None, vision: Overrides | None = None) -> Any:
    """Return the family's tiny configuration for a tokenizer, with overrides."""
    transformers = load_transformers()
    ids = {name: tokenizer.convert_tokens_to_ids(token) for name, token in _SPECIAL[family].items()}
    text_settings = {"vocab_size": len(tokenizer), "pad_token_id": ids["pad"], "eos_token_id": ids["eos"]}
    if "bos" in ids:
        text_settings["bos_token_id"] = ids["bos"]
    match family:
        case "qwen3-vl":
            return _qwen3_vl(transformers, ids, _TEXT | text_settings, text or {}, vision or {})
        case "gemma-4":
            return _gemma_4(transformers, ids, _TEXT | text_settings, text or {}, vision or {})
        case "llava-next-video":
            return _llava_next_video(transformers, ids, _TEXT | text_settings, text or {}, vision or {})


def _qwen3_vl(transformers: Any, ids: Mapping[str, int], base: Overrides, text: Overrides, vision: Overrides) -> Any:
    words = {
        **base,
        "max_position_embeddings": 4096,
        "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [4, 2, 2]},
        **text,
    }
    vision_config = {
        "depth": 2,
        "hidden_size": _VISION_SIZE,
        "intermediate_size": 64,
        "num_heads": 2,
        "num_position_embeddings": 64,
        "deepstack_visual_indexes": [0, 1],
        "out_hidden_size": words["hidden_size"],
        **vision,
    }
    return transformers.Qwen3VLConfig(
        text_config=words,
        vision_config=vision_config,
        image_token_id=ids["image"],
        video_token_id=ids["video"],
        vision_start_token_id=ids["vision_start"],
        vision_end_token_id=ids["vision_end"],
        tie_word_embeddings=True,
    )


def _gemma_4(transformers: Any, ids: Mapping[str, int], base: Overrides, text: Overrides, vision: Overrides) -> Any:
    """Build a model like E4B.

    It has sliding and full attention, per-layer embeddings, and upper blocks that read the keys and values of lower
    ones, below which there are blocks whose keys and values no other block reads.
    """
    words = {
        **base,
        "vocab_size_per_layer_input": base["vocab_size"],
        "hidden_size_per_layer_input": 64,  # a multiple of 64, as NF4 needs on a CPU
        "global_head_dim": 32,
        "num_hidden_layers": 6,
        "num_kv_shared_layers": 2,
        "layer_types": ["sliding_attention", "full_attention"] * 3,
        "sliding_window": 64,
        **text,
    }
    vision_config = {
        "hidden_size": _VISION_SIZE,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "num_key_value_heads": 2,
        "head_dim": 16,
        "position_embedding_size": 256,
        **vision,
    }
    return transformers.Gemma4Config(
        text_config=words,
        vision_config=vision_config,
        audio_config=None,
        boi_token_id=ids["boi"],
        eoi_token_id=ids["eoi"],
        image_token_id=ids["image"],
        video_token_id=ids["video"],
        boa_token_id=ids["boa"],
        eoa_token_index=ids["eoa"],
        audio_token_id=ids["audio"],
    )


def _llava_next_video(
    transformers: Any, ids: Mapping[str, int], base: Overrides, text: Overrides, vision: Overrides
) -> Any:
    words = {**base, "max_position_embeddings": 4096, **text}
    vision_config = {
        "model_type": "clip_vision_model",
        "hidden_size": _VISION_SIZE,
        "intermediate_size": 64,
        "num_hidden_layers": 3,
        "num_attention_heads": 2,
        "projection_dim": 32,
        "patch_size": 14,
        "image_size": 56,
        **vision,
    }
    return transformers.LlavaNextVideoConfig(
        text_config=transformers.LlamaConfig(**words),
        vision_config=transformers.CLIPVisionConfig(**vision_config),
        image_token_index=ids["image"],
        video_token_index=ids["video"],
        image_grid_pinpoints=[[vision_config["image_size"], vision_config["image_size"] * 2]],
    )


def make_processor(family: Family, tokenizer: Any, video: Overrides | None = None) -> Any:
    """Return the family's processor for a tokenizer; `video` overrides its video part."""
    transformers = load_transformers()
    video_settings = dict(video or {})
    match family:
        case "qwen3-vl":
            video_sizes = {
                "size": {"shortest_edge": 32 * 32, "longest_edge": 2 * 64 * 64},
                "cap_pixels_per_frame": False,
            }
            video_processor = transformers.Qwen3VLVideoProcessor(**video_sizes | video_settings)
            image_settings = {
                name: getattr(video_processor, name) for name in ("patch_size", "image_mean", "image_std")
            }
            image_settings["size"] = {
                "shortest_edge": (2 * video_processor.patch_size) ** 2,
                "longest_edge": _STILL_PIXELS,
            }
            return transformers.Qwen3VLProcessor(
                image_processor=transformers.Qwen2VLImageProcessor(
                    **image_settings
                ),  # a server may receive frames one by one
                tokenizer=tokenizer,
                video_processor=video_processor,
                chat_template=_TEMPLATES[family],
            )
        case "gemma-4":
            return transformers.Gemma4Processor(
                feature_extractor=transformers.Gemma4AudioFeatureExtractor(),
                image_processor=transformers.Gemma4ImageProcessor(),
                tokenizer=tokenizer,
                video_processor=transformers.Gemma4VideoProcessor(**video_settings),
                chat_template=_TEMPLATES[family],
            )
        case "llava-next-video":
            side = {"size": {"shortest_edge": 56}, "crop_size": {"height": 56, "width": 56}}
            return transformers.LlavaNextVideoProcessor(
                video_processor=transformers.LlavaNextVideoVideoProcessor(**side | video_settings),
                image_processor=transformers.LlavaNextImageProcessor(**side, image_grid_pinpoints=[[56, 112]]),
                tokenizer=tokenizer,
                chat_template=_TEMPLATES[family],
                patch_size=14,
                vision_feature_select_strategy="default",
                num_additional_image_tokens=1,
            )
