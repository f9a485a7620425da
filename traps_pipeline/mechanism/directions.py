"""Compute void directions and save them as files (docs/spec.md 8.1).

A direction is the unit vector of mean(h_void) - mean(h_control) at one layer. Its nulls are unit vectors too, drawn
from three distributions and made orthogonal to it, so that no null contains a part of the direction:

- `isotropic`: every direction is equally likely;
- `covariance`: drawn from the covariance of the states within a side, so that a null lies where states vary;
- `shuffled`: the mean difference after the sides of half of the pairs, chosen at random, were swapped. Without the
  projection it would lie along the direction or its reverse: with ten pairs its cosine often exceeds 0.7.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.files import write_bytes, write_text

VOID = "void"
NULLS = ("isotropic", "covariance", "shuffled")
KINDS = (VOID, *NULLS)
_LENGTHS = ("gaps", "residual_norms")
_NOTHING_LEFT = 1e-5  # share of a null's length below which the remainder of the projection is rounding error
SITE = "output of the block, before the next one (residual stream); layer 0: embeddings"


# --- which pairs ------------------------------------------------------------------------------------------------------


def seeded_order(scenarios: Sequence[str], seed: int) -> list[str]:
    """Return scenario ids in an order of seed and name alone, so that losing one moves none."""
    return sorted(scenarios, key=lambda name: digest([seed, name]))


def steered_scenarios(scenarios: Sequence[str], n: int, seed: int) -> list[str]:
    """Return the first n scenario ids of the seeded order, to be steered."""
    return seeded_order(scenarios, seed)[:n]


def direction_scenarios(scenarios: Sequence[str], n: int, seed: int) -> list[str]:
    """Return the last n scenario ids of the seeded order, to compute a direction from."""
    return seeded_order(scenarios, seed)[-n:]


# --- the value --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Origin:
    """The provenance of directions, as in the JSON file beside their tensors."""

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
    """The directions in state space computed from one dataset, at every layer.

    vectors: kind -> (draws, layers, d) float32 unit vectors, with one draw of kind void. gaps: (layers,), length of
    mean(h_void) - mean(h_control), the class gap. residual_norms: (layers,), mean length of the control states.
    scenarios: those that the directions come from, which are not steered along them.
    """

    vectors: Mapping[str, np.ndarray]
    gaps: np.ndarray
    residual_norms: np.ndarray
    scenarios: frozenset[str] = frozenset()

    @property
    def void(self) -> np.ndarray:
        """The void direction at every layer, (layers, d)."""
        return self.vectors[VOID][0]

    @property
    def n_layers(self) -> int:
        """The number of layers, the embeddings included."""
        return len(self.residual_norms)


def extract_directions(
    void: np.ndarray, control: np.ndarray, seed: Sequence[int], nulls: Sequence[str] = NULLS, draws: int = 1
) -> Directions:
    """Return directions from states (layers, pairs, d) of the two sides.

    The pairs of both sides are in the same order. Each kind of null has several draws. A layer at which the sides do
    not differ at all (the embeddings of a last token that is the same everywhere) has a zero vector, not a direction
    that consists of rounding errors; so has a null that the projection leaves empty. Raises TrapsError with fewer than
    two pairs.
    """
    if void.shape != control.shape or void.ndim != 3 or void.shape[1] < 2:
        raise TrapsError(
            f"a direction needs two pairs at least, but states are {void.shape} and {control.shape} (layers, pairs, "
            "width); take more scenarios"
        )
    difference = void.astype(np.float64) - control
    raw = difference.mean(axis=1)
    gaps = np.linalg.norm(raw, axis=1)
    unit = raw / np.where(gaps > 0, gaps, 1)[:, None]
    vectors = {VOID: unit[None]}
    for number, kind in enumerate(NULLS):
        if kind in nulls:
            null_vectors = _null_draws(kind, void, control, np.random.default_rng([*seed, number]), draws)
            vectors[kind] = _orthogonal(null_vectors, unit)
    directions = {kind: vector.astype(np.float32) for kind, vector in vectors.items()}
    return Directions(directions, gaps, np.linalg.norm(control, axis=2).mean(axis=1))


def _null_draws(kind: str, void: np.ndarray, control: np.ndarray, rng: np.random.Generator, draws: int) -> np.ndarray:
    """Return draws of a kind of null before the projection, (draws, layers, d)."""
    layers, pairs, width = void.shape
    if kind == "isotropic":
        return rng.standard_normal((draws, layers, width))
    if kind == "shuffled":
        swaps = np.stack([rng.permutation(np.resize([-1.0, 1.0], pairs)) for _ in range(draws)])
        return np.einsum("kn,lnd->kld", swaps, void.astype(np.float64) - control) / pairs
    centred = [side - side.mean(axis=1, keepdims=True) for side in (void.astype(np.float64), control)]
    return np.einsum("kn,lnd->kld", rng.standard_normal((draws, 2 * pairs)), np.concatenate(centred, axis=1))


def _orthogonal(vectors: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return unit vectors (draws, layers, d) less their part along unit (layers, d); zero if hardly any is left."""
    remainder = vectors - (vectors * unit).sum(axis=2, keepdims=True) * unit
    remainder -= (remainder * unit).sum(axis=2, keepdims=True) * unit  # again, since the first projection rounds
    norm_before, norm_after = (np.linalg.norm(vector, axis=2, keepdims=True) for vector in (vectors, remainder))
    is_direction = np.abs(unit).max(axis=1) > 0
    mask = (norm_after > _NOTHING_LEFT * norm_before) & is_direction[None, :, None]
    return np.where(mask, remainder / np.where(mask, norm_after, 1), 0.0)


def vector_digest(vector: np.ndarray) -> str:
    """Return the digest of a direction's numbers in float32."""
    return hashlib.sha256(np.ascontiguousarray(vector, "<f4").tobytes()).hexdigest()[:32]


def save_directions(path: Path, directions: Directions, origin: Origin) -> None:
    """Write `path` (safetensors) and a JSON file of the same name that describes it.

    Tensors: kind -> (draws, layers, d), gaps and residual_norms -> (layers,). Raises TrapsError if the disk is full.
    """
    require_extra("local")
    from safetensors.numpy import save

    tensors = {kind: np.ascontiguousarray(vectors) for kind, vectors in directions.vectors.items()}
    tensors |= {name: np.asarray(getattr(directions, name), np.float64) for name in _LENGTHS}
    write_bytes(path, save(tensors))
    description = asdict(origin) | {"n_pairs": len(origin.scenarios), "tensors_sha256": file_digest(path)}
    write_text(path.with_suffix(".json"), json.dumps(description, indent=1, sort_keys=True))


def load_directions(path: Path) -> tuple[Directions, dict[str, Any]]:
    """Return saved directions and the content of their JSON file. Raises TrapsError if one is missing or altered."""
    require_extra("local")
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
    if not {VOID, *_LENGTHS} <= set(tensors):
        raise TrapsError(f"{path}: was written by an earlier version; delete it, then `traps run` makes it again")
    return Directions(
        {kind: tensors[kind] for kind in KINDS if kind in tensors},
        **{n: tensors[n] for n in _LENGTHS},
        scenarios=frozenset(description["scenarios"]),
    ), description


def cosine_matrix(vectors: np.ndarray) -> np.ndarray:
    """Return cosines of unit vectors, (k, d) -> (k, k); NaN if either is zero."""
    vectors = np.asarray(vectors, np.float64)
    lengths = np.linalg.norm(vectors, axis=1)
    with np.errstate(invalid="ignore"):
        return np.clip((vectors @ vectors.T) / np.outer(lengths, lengths), -1, 1)
