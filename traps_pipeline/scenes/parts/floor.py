"""Draw floors with a pattern of two muted colours; no motion depends on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.parts.vary import Drawn, Group, together

if TYPE_CHECKING:
    import mujoco

# sRGB of floors. All are too pale, too dark or too dull to be taken for a colour that a question names.
TONES: Mapping[str, tuple[float, float, float]] = {
    "chalk": (0.90, 0.89, 0.86),
    "sand": (0.80, 0.75, 0.66),
    "clay": (0.62, 0.52, 0.46),
    "stone": (0.60, 0.61, 0.60),
    "moss": (0.44, 0.48, 0.40),
    "slate": (0.33, 0.36, 0.39),
    "coal": (0.21, 0.21, 0.20),
}
PALE_TONES = ("chalk", "sand", "clay", "stone", "moss")  # on which what is black, and the masts of flags, show
PATTERNS = ("checks", "stripes", "planks")
PLAIN_SHARE = 0.08  # of floors that have no pattern: two of a family would look alike
TEXELS = 256  # of a side of the texture, which shows one repeat of the pattern


def floors(tones: Sequence[str] = tuple(TONES)) -> Group:
    """Return a group of the fields `floor_*` of `Look`, drawn of some tones."""

    def draw(rng: np.random.Generator, so_far: Drawn) -> tuple[str, tuple[str, ...], float, float, tuple[float, ...]]:
        pattern = PATTERNS[int(rng.integers(len(PATTERNS)))] if rng.random() > PLAIN_SHARE else "plain"
        tone_pair = tuple(str(tone) for tone in rng.permutation(list(tones))[:2])
        repeat = round(float(rng.uniform(0.5, 1.5)), 2)
        turn = round(float(rng.uniform(-45, 45)), 1)
        return pattern, tone_pair, repeat, turn, tuple(round(float(x), 2) for x in rng.uniform(0, repeat, 2))

    return together(draw)


def lay_floor(spec: mujoco.MjSpec, p: Any) -> None:
    """Give the floor of a world its pattern, from the fields of `floors`."""
    import mujoco

    first, second = (np.array(TONES[tone]) * 255 for tone in p.floor_tones)
    texture = spec.add_texture(name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.width = texture.height = TEXELS
    texture.nchannel = 3
    share = _shares(p.floor_pattern)[..., None]
    texture.data = np.rint(first * (1 - share) + second * share).astype(np.uint8).tobytes()
    material = spec.material("floor")
    material.rgba = [1, 1, 1, 1]
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    material.texuniform, material.texrepeat = True, [1 / p.floor_repeat_m] * 2
    floor = spec.geom("floor")
    half_turn = np.radians(p.floor_turn_deg) / 2
    floor.quat, floor.pos = [np.cos(half_turn), 0, 0, np.sin(half_turn)], [*p.floor_shift_m, 0]


def _shares(pattern: str) -> np.ndarray:
    """Return the share of the second tone in each texel, (TEXELS, TEXELS)."""
    down, right = np.mgrid[:TEXELS, :TEXELS] / TEXELS
    match pattern:
        case "plain":
            return np.zeros((TEXELS, TEXELS))
        case "checks":
            return ((down < 0.5) ^ (right < 0.5)).astype(float)
        case "stripes":
            return (right < 0.5).astype(float)
        case "planks":  # four planks beside each other, their ends staggered, of tones in between
            plank = np.floor(4 * right).astype(int)
            end = np.array([0.1, 0.6, 0.35, 0.85])[plank]
            tone = np.array([0.0, 0.45, 0.2, 0.6, 0.35])[(plank + (down > end)) % 5]
            return np.where((4 * right) % 1 < 0.06, 1.0, np.where(np.abs(down - end) < 0.008, 1.0, tone))
    raise ValueError(f"no floor pattern {pattern!r}; there are plain, {', '.join(PATTERNS)}")
