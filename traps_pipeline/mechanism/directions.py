"""Void directions: the mean difference between voids and controls, as a value that is saved (docs/spec.md 8.1).

A direction is the unit vector of mean(h_void) - mean(h_control) at one layer. It has two controls of the same norm: a
random direction, and one from shuffled labels, for which the sides of half of the pairs, drawn at random, are swapped.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.digests import digest, file_digest
from traps_pipeline.errors import TrapsError
from traps_pipeline.files import write_bytes, write_text

KINDS = ("void", "random", "shuffled")
SITE = "output of the block, before the next one (residual stream); layer 0: embeddings"


# --- which pairs ------------------------------------------------------------------------------------------------------


def seeded_order(scenarios: Sequence[str], seed: int) -> list[str]:
    """The scenarios in an order by seed and name alone, so that a discarded one does not change the others' order."""
    return sorted(scenarios, key=lambda name: digest([seed, name]))


def steered_scenarios(scenarios: Sequence[str], n: int, seed: int) -> list[str]:
    """The first n scenarios of the seeded order of a taxonomy, which are steered in every cell."""
    return seeded_order(scenarios, seed)[:n]


def direction_scenarios(scenarios: Sequence[str], n: int, seed: int) -> list[str]:
    """The last n scenarios of the same order, from which a direction is computed; where there are enough scenarios,
    none of these is steered."""
    return seeded_order(scenarios, seed)[-n:]


# --- the value --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Origin:
    """The origin of a set of directions, which is written into the JSON file beside the tensors."""

    model: str
    checkpoint: str
    checkpoint_digest: str
    dtype: str
    quantisation: str
    dataset: str
    prompt: str
    pooling: str
    seed: int
    scenarios: tuple[str, ...]
    states_digest: str
    site: str = SITE


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions of one dataset at every layer. vectors: kind -> (layers, d) float32 unit vectors. norms: kind ->
    (layers,), lengths before normalisation. residual_norms: (layers,), mean length of the control states."""

    vectors: Mapping[str, np.ndarray]
    norms: Mapping[str, np.ndarray]
    residual_norms: np.ndarray

    @property
    def n_layers(self) -> int:
        """Layers, the embeddings included."""
        return len(self.residual_norms)


def extract_directions(void: np.ndarray, control: np.ndarray, seed: Sequence[int]) -> Directions:
    """Directions from states (layers, pairs, d) of the two sides, with the pairs in the same order.

    A layer at which the sides do not differ at all (the embeddings of a last token that is the same everywhere) has a
    zero vector, not a direction that consists of rounding errors. Raises TrapsError with fewer than two pairs.
    """
    if void.shape != control.shape or void.ndim != 3 or void.shape[1] < 2:
        raise TrapsError(
            f"a direction needs two pairs at least, but states are {void.shape} and {control.shape} (layers, pairs, "
            "width); take more scenarios"
        )
    rng = np.random.default_rng(list(seed))
    difference = void.astype(np.float64) - control
    swaps = rng.permutation(np.resize([-1.0, 1.0], difference.shape[1]))
    raw = {
        "void": difference.mean(axis=1),
        "shuffled": (difference * swaps[None, :, None]).mean(axis=1),
        "random": rng.standard_normal((difference.shape[0], difference.shape[2])),
    }
    norms = {kind: np.linalg.norm(vectors, axis=1) for kind, vectors in raw.items()}
    units = {kind: (raw[kind] / np.where(norms[kind] > 0, norms[kind], 1)[:, None]).astype(np.float32) for kind in raw}
    return Directions(units, norms | {"random": np.ones(len(void))}, np.linalg.norm(control, axis=2).mean(axis=1))


def vector_digest(vector: np.ndarray) -> str:
    """Digest of a direction's float32 numbers."""
    return hashlib.sha256(np.ascontiguousarray(vector, "<f4").tobytes()).hexdigest()[:32]


def save_directions(path: Path, directions: Directions, origin: Origin) -> None:
    """Write `path` (safetensors: kind -> (layers, d), norms.kind and residual_norms -> (layers,)), and a JSON file of
    the same name that says what it holds. Raises TrapsError when the disk is full."""
    from safetensors.numpy import save

    tensors = {kind: np.ascontiguousarray(vectors) for kind, vectors in directions.vectors.items()}
    tensors |= {f"norms.{kind}": np.asarray(norms, np.float64) for kind, norms in directions.norms.items()}
    tensors["residual_norms"] = np.asarray(directions.residual_norms, np.float64)
    write_bytes(path, save(tensors))
    description = asdict(origin) | {"n_pairs": len(origin.scenarios), "tensors_sha256": file_digest(path)}
    write_text(path.with_suffix(".json"), json.dumps(description, indent=1, sort_keys=True))


def load_directions(path: Path) -> tuple[Directions, dict[str, Any]]:
    """The directions that `save_directions` wrote, and the content of their JSON file. Raises TrapsError when a file is
    missing, or when the digest in the JSON file is another."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        description = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        if file_digest(path) != description["tensors_sha256"]:
            raise ValueError("its digest differs from the one in its JSON file")
        tensors = load_file(path)
    except FileNotFoundError:
        raise TrapsError(f"{path}: it or its JSON file is missing; `traps run` makes both from the states") from None
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise TrapsError(f"{path}: damaged ({error}); delete it, then `traps run` makes it again") from error
    vectors = {kind: tensors[kind] for kind in KINDS}
    norms = {kind: tensors[f"norms.{kind}"] for kind in KINDS}
    return Directions(vectors, norms, tensors["residual_norms"]), description


def cosine_matrix(vectors: np.ndarray) -> np.ndarray:
    """Cosines of unit vectors (k, d): (k, k). NaN where one of the two is zero."""
    vectors = np.asarray(vectors, np.float64)
    lengths = np.linalg.norm(vectors, axis=1)
    with np.errstate(invalid="ignore"):
        return np.clip((vectors @ vectors.T) / np.outer(lengths, lengths), -1, 1)
