"""Where a chaotic clip can be cut: the futures of many starts that look the same up to the cut.

The initial state is perturbed far below what a pixel shows and simulated on. A rollout is accepted for a cut while it
cannot be told from the control by eye; the cut is the latest one whose accepted rollouts still end differently.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.camera import Camera
from traps_pipeline.scenes.kit import Family, Physics
from traps_pipeline.scenes.simulate import initial_velocity, replay

if TYPE_CHECKING:
    import mujoco

EARLIEST_CUT_S = 1.0
MAX_DEVIATION_PX = 0.5
MIN_ACCEPTED = 64
TRIED = 128
BATCHES = (
    24,
    80,
    TRIED,
)  # rollouts tried in all after each batch; the next batch runs only if it can change the verdict
TOP_SHARE = 0.65
MIN_ENTROPY_BITS = 1.0
MIN_ENTROPY_THREE_LABELS_BITS = 0.9
HELD_S = 0.6  # a rollout's label must have stood this long at the end, like the control's
HOPELESS_SHARE = 0.9  # of the scouts; a scene whose true top share is 65 % looks like that less than once in 300 times
THREADS = 2


@dataclass(frozen=True)
class Cut:
    """A cut and what it leaves open. The void shows control frames [0:frame].

    accepted: rollouts with an outcome that look like the control up to the cut. unresolved: rollouts that look like it
    but are undecided at the end; they are no outcome of their own and count nowhere else.
    """

    frame: int
    entropy_bits: float
    top_share: float
    accepted: int
    tried: int
    unresolved: int
    perturbation: float

    def evidence(self) -> dict[str, Any]:
        """Plain values for the record."""
        return {
            "entropy_bits": round(self.entropy_bits, 4),
            "top_share": round(self.top_share, 4),
            "accepted": self.accepted,
            "tried": self.tried,
            "unresolved": self.unresolved,
            "perturbation": self.perturbation,
        }


@dataclass(frozen=True)
class Rollout:
    """One perturbed future. parted: first frame that looks different from the control (n_frames if none does).

    qpos (F, nq) float32: its trajectory, None if it parted before the earliest cut or diverged.
    """

    parted: int
    label: str | None
    qpos: np.ndarray | None = None


def entropy_bits(counts: Mapping[str, int]) -> float:
    """Shannon entropy (bits) of outcome counts; 0 for no outcome at all."""
    total = sum(counts.values())
    return sum(-n / total * math.log2(n / total) for n in counts.values() if n)


def earliest_cut(physics: Physics) -> int:
    """The first admissible cut frame: its last shown frame, frame - 1, is at 1.0 s or later."""
    return math.ceil(EARLIEST_CUT_S * physics.fps - 1e-9) + 1


def choose_cut(
    family: Family, params: Any, physics: Physics, camera: Camera, qpos: np.ndarray, commit_frame: int, seed: int
) -> tuple[Cut, Rollout] | None:
    """The latest cut from 1.0 s on and before commitment that leaves the outcome open, and a twin; None without one.

    qpos (F, nq): the control. Of at most 128 perturbed starts at least 64 must be accepted, with an outcome entropy of
    at least 1.0 bit (0.9 for families of three labels) and no outcome above 65 %. The twin is an accepted rollout that
    ends otherwise than the control does.
    """
    first = earliest_cut(physics)
    if commit_frame < first:
        return None
    bound = bound_bits(family, params)
    for rollouts in futures(family, params, physics, camera, qpos, seed):
        if len(rollouts) == BATCHES[0]:
            if _hopeless(rollouts, first):
                return None
            continue
        cut = latest_open_cut(rollouts, range(first, commit_frame + 1), bound, family.perturbation)
        if cut is not None:
            model = family.build(params, physics).spec.compile()
            truth = family.outcome(replay(model, qpos, physics), params).labels[-1]
            return cut, twin_of(rollouts, cut.frame, truth)
    return None


def bound_bits(family: Family, params: Any) -> float:
    """The least entropy (bits) that a cut must leave open: 1.0, or 0.9 where there are three outcomes."""
    labels = len(family.word(params, np.random.default_rng(0)).labels)
    return MIN_ENTROPY_THREE_LABELS_BITS if labels == 3 else MIN_ENTROPY_BITS


def futures(
    family: Family, params: Any, physics: Physics, camera: Camera, qpos: np.ndarray, seed: int
) -> Iterator[list[Rollout]]:
    """Rollouts of perturbed starts of a control qpos (F, nq): all so far after each batch of `BATCHES`."""
    scene = family.build(params, physics)
    model = scene.spec.compile()
    silhouette = _Silhouette(model, camera)
    shown = np.stack([silhouette.pixels(row) for row in qpos])
    velocity = initial_velocity(model, scene.velocity)
    starts = _perturbed_starts(model, np.asarray(qpos[0], float), family.perturbation, seed)
    first = earliest_cut(physics)

    def roll(start: np.ndarray) -> Rollout:
        return _roll(family, params, physics, model, start, velocity, silhouette, shown, first)

    rollouts: list[Rollout] = []
    with ThreadPoolExecutor(THREADS) as pool:  # mj_step releases the GIL
        for tried in BATCHES:
            rollouts += pool.map(roll, starts[len(rollouts) : tried])
            yield rollouts


def latest_open_cut(rollouts: Sequence[Rollout], frames: range, bound_bits: float, perturbation: float) -> Cut | None:
    """The last of the frames at which the accepted rollouts leave the outcome open, or None."""
    cuts = (open_at(rollouts, frame, bound_bits, perturbation) for frame in reversed(frames))
    return next((cut for cut in cuts if cut is not None), None)


def open_at(rollouts: Sequence[Rollout], frame: int, bound_bits: float, perturbation: float) -> Cut | None:
    """The cut at one frame if it leaves the outcome open, else None."""
    alike = [r for r in rollouts if r.parted >= frame]
    counts = Counter(r.label for r in alike if r.label is not None)
    accepted = counts.total()
    if accepted < MIN_ACCEPTED:
        return None
    entropy, top = entropy_bits(counts), max(counts.values()) / accepted
    if entropy < bound_bits or top > TOP_SHARE:
        return None
    return Cut(frame, entropy, top, accepted, len(rollouts), len(alike) - accepted, perturbation)


def twin_of(rollouts: Sequence[Rollout], frame: int, truth: str | None) -> Rollout:
    """The first accepted rollout at a cut that ends otherwise than the truth: the same clip, another answer."""
    return next(r for r in rollouts if r.parted >= frame and r.label not in (None, truth))


def deviation_px(model: mujoco.MjModel, camera: Camera, qpos: np.ndarray, twin: np.ndarray) -> float:
    """The furthest (px) that any corner or outline point of a moving body is from its place in the other trajectory."""
    silhouette = _Silhouette(model, camera)
    return max(
        float(np.abs(silhouette.pixels(a) - silhouette.pixels(b)).max()) for a, b in zip(qpos, twin, strict=True)
    )


def _hopeless(scouts: Sequence[Rollout], first: int) -> bool:
    """Whether hardly any scout looks like the control at the earliest cut, or nearly all of them end alike."""
    counts = Counter(r.label for r in scouts if r.parted >= first and r.label is not None)
    few = counts.total() < len(scouts) * MIN_ACCEPTED / TRIED / 2
    return few or max(counts.values(), default=0) > HOPELESS_SHARE * counts.total()


def _perturbed_starts(model: mujoco.MjModel, start: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """TRIED starts, shape (TRIED, nq): a normal step of one scale (m, rad) on every degree of freedom."""
    import mujoco

    steps = np.random.default_rng([seed, TRIED]).normal(scale=scale, size=(TRIED, model.nv))
    starts = np.tile(start, (TRIED, 1))
    for row, step in zip(starts, steps, strict=True):
        mujoco.mj_integratePos(model, row, step, 1.0)
    return starts


def _roll(
    family: Family,
    params: Any,
    physics: Physics,
    model: mujoco.MjModel,
    start: np.ndarray,
    velocity: np.ndarray,
    silhouette: _Silhouette,
    shown: np.ndarray,
    first: int,
) -> Rollout:
    """Simulate one start to the end of the control; give up early if it parts before the earliest cut."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start, velocity
    frames = np.empty((len(shown), model.nq))
    parted = len(shown)
    for i in range(len(shown)):
        frames[i] = data.qpos
        if parted == len(shown) and np.abs(silhouette.pixels(data.qpos) - shown[i]).max() > MAX_DEVIATION_PX:
            parted = i
            if i < first:
                return Rollout(parted, None)
        mujoco.mj_step(model, data, physics.substeps)
    if not np.isfinite(frames).all():
        return Rollout(parted, None)
    label = _settled(family.outcome(replay(model, frames, physics), params).labels, physics)
    return Rollout(parted, label, frames.astype(np.float32))


def _settled(labels: Sequence[str | None], physics: Physics) -> str | None:
    """The label that holds at the end and has held for 0.6 s, else None."""
    held = labels[-1 - round(HELD_S * physics.fps) :]
    return labels[-1] if len(set(held)) == 1 else None


class _Silhouette:
    """Pixels by which two poses are told apart: the corners of moving geoms' boxes, the outline of moving balls.

    A ball's outline does not turn with the ball: its spin cannot be seen.
    """

    def __init__(self, model: mujoco.MjModel, camera: Camera) -> None:
        import mujoco

        self._model, self._camera = model, camera
        moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0)
        ball = model.geom_type[moving] == mujoco.mjtGeom.mjGEOM_SPHERE
        self._balls, self._solids = moving[ball], moving[~ball]
        signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T
        boxes = model.geom_aabb[self._solids]
        self._corners = boxes[:, None, :3] + signs * boxes[:, None, 3:]
        right, up, _ = camera.axes()
        outline = np.stack([right, -right, up, -up])
        self._outline = model.geom_size[self._balls, :1, None] * outline

    def pixels(self, qpos: np.ndarray) -> np.ndarray:
        """Pixel coordinates of all outline points in one pose, shape (N, 2)."""
        import mujoco

        data = mujoco.MjData(self._model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, data)
        rotation = data.geom_xmat[self._solids].reshape(-1, 3, 3)
        corners = np.einsum("gij,gkj->gki", rotation, self._corners) + data.geom_xpos[self._solids, None]
        outline = self._outline + data.geom_xpos[self._balls, None]
        return self._camera.project(np.concatenate([corners.reshape(-1, 3), outline.reshape(-1, 3)]))
