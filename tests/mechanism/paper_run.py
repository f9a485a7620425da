"""The paper's mechanistic experiment on tiny checkpoints of its three families.

The section `mechanism` is that of `assets/experiments/paper.yaml` but for six things: layers are those of a few blocks
at the same share of the depth, frames are few and small, the scenarios are too few for five folds, a direction
comes from two pairs and steers another, and answers are short, since a random model never ends one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from traps_pipeline.models.local.tiny import Family, build_tiny
from traps_pipeline.models.registry.prompts import PROMPTS
from traps_pipeline.pipeline.experiment import EXPERIMENTS

if TYPE_CHECKING:
    from tokenizers import Tokenizer

NEW_TOKENS = 2
# Blocks of the tiny checkpoints; with all blocks of the paper's models the run takes four times as long.
BLOCKS: Mapping[str, int] = {"qwen3-vl-8b": 4, "gemma-4-e4b": 6, "llava-next-video-7b": 4}
# Model of the paper -> family and its blocks: with the embeddings, 37, 43 and 33 layers (docs/spec.md 7.1).
DEPTHS: Mapping[str, tuple[Family, int]] = {
    "qwen3-vl-8b": ("qwen3-vl", 36),
    "gemma-4-e4b": ("gemma-4", 42),
    "llava-next-video-7b": ("llava-next-video", 32),
}


def paper() -> dict[str, Any]:
    """The experiment of the paper as it stands in its file."""
    return yaml.safe_load((EXPERIMENTS / "paper.yaml").read_text(encoding="utf-8"))


def shallow(layer: int, model: str) -> int:
    """The layer of a model's tiny checkpoint at the same share of the depth: 20 of 36 is 2 of 4."""
    return max(1, round(layer * BLOCKS[model] / DEPTHS[model][1]))


def mechanism() -> dict[str, Any]:
    """The section `mechanism` for the tiny checkpoints."""
    section = paper()["mechanism"]
    for model in DEPTHS:
        layers = section["models"][model]
        layers.pop("media", None)  # tiny checkpoints are shown what `tiny` says
        for name, layer in layers.items():
            deep = layer if isinstance(layer, list) else [layer]
            found = sorted({shallow(one, model) for one in deep})
            layers[name] = found if isinstance(layer, list) else found[0]
    section["probes"]["folds"] = 2
    section["steering"] |= {"max_new_tokens": NEW_TOKENS, "pairs": 1, "well_posed_pairs": 2, "ill_posed_pairs": 2}
    return section


def tiny(entry: dict[str, Any], checkpoint: Path) -> dict[str, Any]:
    """An entry of the paper's, asked of a tiny checkpoint on the CPU: two small frames, and nothing quantised."""
    params = {"checkpoint": str(checkpoint), "dtype": "float32", "quantisation": "none", "do_sample": False}
    params["max_new_tokens"] = NEW_TOKENS
    media = {"profile": "frames", "uniform": 2, "size": [32, 32]}
    waivers = {"media": "two small frames for a tiny checkpoint"}
    return {"id": entry["id"], "backend": "local", "device": "cpu", "media": media, "params": params, "runs": 1,
            "waivers": waivers, "groups": entry["groups"]}  # fmt: skip


def words(questions: str = "") -> Tokenizer:
    """Return a tokenizer with a token a word of the prompts and questions: bytes make prompts six times as long.

    Whatever words a random model writes, its text is `left`, which the rule judges read; a token alone is its word.
    """
    from tokenizers import Regex, Tokenizer, decoders
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace

    spoken = " ".join([questions, *(file.read_text(encoding="utf-8") for file in sorted(PROMPTS.glob("*.txt")))])
    known = ["[unknown]", *sorted({*re.findall(r"\w+|[^\w\s]+", spoken)})]
    tokenizer = Tokenizer(WordLevel({word: k for k, word in enumerate(known)}, unk_token="[unknown]"))
    tokenizer.pre_tokenizer = Whitespace()
    as_left = decoders.Replace(Regex(r"[\s\S]+ [\s\S]+"), "left")
    tokenizer.decoder = decoders.Sequence([decoders.WordPiece(cleanup=False), decoders.Fuse(), as_left])
    return tokenizer


def write(registry: Path, folder: Path, scenarios: list[str]) -> Path:
    """Build the checkpoints below a folder, let a registry's entries of the three models name them, and write the
    experiment; returns its file."""
    known = yaml.safe_load(registry.read_text(encoding="utf-8"))
    for model, (family, _) in DEPTHS.items():
        build_tiny(family, folder / model, tokenizer=words())
        place = next(k for k, entry in enumerate(known["models"]) if entry["id"] == model)
        known["models"][place] = tiny(known["models"][place], folder / model)
    registry.write_text(yaml.safe_dump(known, sort_keys=False), encoding="utf-8")
    experiment = {"name": "paper-inside", "models": [*DEPTHS], "regimes": ["standard"], "panel": "rules"}
    experiment |= {"judged_by_rules": True, "epoch": "tiny", "scenarios": scenarios, "mechanism": mechanism()}
    path = folder / "paper-inside.yaml"
    path.write_text(yaml.safe_dump(experiment, sort_keys=False), encoding="utf-8")
    return path
