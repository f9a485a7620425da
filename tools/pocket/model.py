"""The pocket model's parts: its tokenizer, its configuration of the Qwen3-VL class, and the folder it is saved in."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tools.pocket.words import COLUMNS, PROMPTS, ROWS, phrases, prompt_text, say
from tools.tiny_checkpoints import make_config, make_processor, make_tokenizer
from traps_pipeline.models.local.library import load_transformers

if TYPE_CHECKING:
    from tokenizers import Tokenizer

FAMILY = "qwen3-vl"
VOCABULARY = 2000  # maximum; prompts, questions and answers have fewer words
PATCH = 8  # pixels; two by two patches are merged into a token
TEXT = {
    "hidden_size": 128,
    "intermediate_size": 256,
    "num_hidden_layers": 4,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "head_dim": 32,
    "initializer_range": 0.06,
    "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [8, 4, 4]},
}
VISION = {
    "depth": 3,
    "hidden_size": 64,
    "intermediate_size": 192,
    "num_heads": 4,
    "initializer_range": 0.1,
    "patch_size": PATCH,
    "num_position_embeddings": 256,
    "deepstack_visual_indexes": [1],
}


def train_tokenizer(records: Iterable[Any], more: Iterable[str] = ()) -> Tokenizer:
    """Return a byte-level BPE tokenizer whose tokens are the words of the scenes' questions and answers, `phrases`, and
    more of them; it splits any other text into smaller pieces."""
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers

    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)  # pyright: ignore[reportAttributeAccessIssue]
    tokenizer.decoder = decoders.ByteLevel()  # pyright: ignore[reportAttributeAccessIssue]
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(vocab_size=VOCABULARY, initial_alphabet=sorted(alphabet), show_progress=False)
    tokenizer.train_from_iterator(_texts(records), trainer)
    tokenizer.add_tokens([AddedToken(phrase, normalized=False) for phrase in (*phrases(), *more)])
    return tokenizer


def _texts(records: Iterable[Any]) -> Iterable[str]:
    yield from (prompt_text(name) for name in PROMPTS)
    yield from (f"<{tenths / 10:.1f} seconds>" for tenths in range(50))
    for record in records:
        yield from record.texts
    yield from (say(name, "standard") for name in (*COLUMNS, *ROWS))


def make_model(tokenizer: Tokenizer, seed: int) -> tuple[Any, Any]:
    """Return the untrained model and its processor. The same seed gives the same weights."""
    import torch

    transformers = load_transformers()
    wrapped = make_tokenizer(FAMILY, tokenizer)
    config = make_config(FAMILY, wrapped, TEXT, VISION)
    torch.manual_seed(seed)
    model = transformers.AutoModelForImageTextToText.from_config(config)
    model.generation_config.eos_token_id = wrapped.eos_token_id
    model.generation_config.pad_token_id = wrapped.pad_token_id
    size = {"shortest_edge": (2 * PATCH) ** 2, "longest_edge": 64 * 480 * 360}
    return model, make_processor(FAMILY, wrapped, {"patch_size": PATCH, "size": size})


def start_from(model: Any, tokenizer: Any, weights: Path) -> None:
    """Give a model the weights of another of its sizes; of tokens that both have, the embeddings."""
    import torch

    transformers = load_transformers()
    other = transformers.AutoModelForImageTextToText.from_pretrained(weights)
    known = transformers.AutoTokenizer.from_pretrained(weights).get_vocab()
    shared = [(own, known[token]) for token, own in tokenizer.get_vocab().items() if token in known]
    mine, theirs = (torch.tensor(ids) for ids in zip(*shared, strict=True))
    embeddings = [each.get_input_embeddings().weight for each in (model, other)]
    with torch.no_grad():
        embeddings[0][mine] = embeddings[1][theirs]
    sized = ("embed_tokens.weight", "lm_head.weight")  # by the number of tokens
    model.load_state_dict({k: v for k, v in other.state_dict().items() if not k.endswith(sized)}, strict=False)


def save(model: Any, processor: Any, folder: Path) -> None:
    """Write the folder that `checkpoint:` of a local model's entry names; weights in half precision, since several
    models ship, and read back as float32."""
    from safetensors.torch import load_file, save_file

    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    weights = folder / "model.safetensors"
    save_file({name: values.half() for name, values in load_file(weights).items()}, weights, {"format": "pt"})
