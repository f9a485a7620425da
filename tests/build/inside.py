"""The golden study with a look into a tiny model."""

from __future__ import annotations

import json

import yaml

from tests.conftest import EXPERIMENT, Checkout
from tests.mechanism.paper_run import words
from tools.tiny_checkpoints import build_tiny

ENTRY = """
  - id: tiny
    backend: local
    device: cpu
    media: {profile: frames, uniform: 2, size: [32, 32]}
    params: {checkpoint: tiny, dtype: float32, quantisation: none, do_sample: false, max_new_tokens: 4}
    runs: 1
"""
MECHANISM = {
    "models": {"tiny": {"steering": 3, "centroid": 4}},
    "prompts": ["standard"],
    "probes": {"folds": 2, "resamples": 100},
    "patching": {"pairs": 2, "exact": 6, "stride": 1},
    "steering": {
        **{"alphas": [5], "pairs": 2, "well_posed_pairs": 4, "ill_posed_pairs": 4, "max_new_tokens": 4},
        **{"direction_regimes": ["standard"], "inference_regimes": ["guided"], "gaps": [1], "signs": ["minus"]},
        "nulls": {"kinds": ["covariance"], "draws": 2},
    },
}


def with_mechanism(study: Checkout) -> str:
    """The small study's experiment on two of its datasets, asking for a look into a tiny model besides."""
    with (study.root / "assets" / "models.yaml").open("a") as stream:
        stream.write(ENTRY)
    records = sorted((study.root / "scene_specs" / "released").glob("*.jsonl"))
    lines = [json.loads(line) for path in records for line in path.read_text(encoding="utf-8").splitlines()]
    questions = " ".join(str(value) for line in lines for name, value in line.items() if "question" in name)
    build_tiny("qwen3-vl", study.root / "tiny", tokenizer=words(questions))
    experiment = yaml.safe_load((study.root / EXPERIMENT).read_text()) | {
        "datasets": ["chaotic", "chaotic_ill_posed"],
        "mechanism": MECHANISM,
    }
    (study.root / "inside.yaml").write_text(yaml.safe_dump(experiment))
    return "inside.yaml"
