"""Simulate futures of starts that look like the control of a pair up to a cut.

The initial state is perturbed far below what a pixel shows and simulated on. A rollout counts for a cut while it cannot
be told from the control by eye. How many must count, and how they must disagree, is the certificate's (`certificates`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.physics.flexes import flex_vertices
from traps_pipeline.scenes.physics.simulate import initial_velocity, replay
from traps_pipeline.scenes.picture.camera import Camera
from traps_pipeline.scenes.worlds.outcome import Rejected, last_run
from traps_pipeline.scenes.worlds.world import World

if TYPE_CHECKING:
    import mujoco

TRIED = 128  # starts at most
AT_CUT = 48  # futures of the state at the cut
UNSEEN_PX = 0.1  # no viewer reads the place of a thing in a frame more finely
READ_OVER_S = 0.2  # nor its speed, from two frames of five a second, more finely than such places over that time tell
# Rollouts tried in all after each batch; the next batch runs only if it can change the verdict.
BATCHES = (24, 80, TRIED)
THREADS = 2


@dataclass(frozen=True)
class Cut:
    """The frame at which a void ends, with the outcome counts of the control's futures from there.

    The void shows the control frames [0:frame].

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
        """Return by name the numbers behind the certificate `open`."""
        return {name: value for name, value in vars(self).items() if name != "frame"}


@dataclass(frozen=True)
class Rollout:
    """One perturbed future of a start.

    parted: first frame that looks different from the control (n_frames if none does). qpos (F, nq) float32: its
    trajectory, None if it was given up or diverged.
    """

    number: int
    parted: int
    label: str | None
    qpos: np.ndarray | None = None


def entropy_bits(counts: Mapping[str, int]) -> float:
    """Return the Shannon entropy (bits) of outcome counts; 0 for none."""
    total = sum(counts.values())
    return sum(-n / total * math.log2(n / total) for n in counts.values() if n)


@dataclass(frozen=True)
class _Prepared:
    """What all rollouts of a control share. starts (TRIED, nq), shown (F, N, 2) px."""

    model: mujoco.MjModel
    starts: np.ndarray
    velocity: np.ndarray
    silhouette: _Silhouette
    shown: np.ndarray


class Futures:
    """The futures of a control: simulations of perturbed starts, each simulated once, on request.

    first: the cut, or the earliest that may be; a rollout that has parted before it counts nowhere and is given up.
    alike_px: a rollout parts from the control when a point of it is further off than this. held_s: so long a label must
    have stood at the end to be an outcome.
    """

    def __init__(self, control: World, seed: int, *, first: int, alike_px: float, held_s: float) -> None:
        self.first = first
        self._control, self._seed = control, seed
        self._alike_px, self._held_frames = alike_px, round(held_s * control.physics.fps)
        self._rollouts: list[Rollout] = []
        self._after: dict[tuple[int, int, int], Counter[str | None]] = {}

    def batches(self) -> Iterator[list[Rollout]]:
        """Yield all rollouts so far after each batch of `BATCHES`."""
        for n_tried in BATCHES:
            if len(self._rollouts) < n_tried:
                self._rollouts += self._roll_all(range(len(self._rollouts), n_tried))
            yield self._rollouts[:n_tried]

    def start(self, number: int) -> np.ndarray:
        """Return a start, (nq,) float64, drawn around the first row of the trajectory. Raises Rejected."""
        if not 0 <= number < TRIED:
            raise Rejected(f"there is no start {number}; there are {TRIED}")
        return self._prepare.starts[number]

    def rollout(self, number: int) -> Rollout:
        """Return the future of one start, simulated here to its end. Raises Rejected."""
        self.start(number)
        existing = self._rollouts[number] if number < len(self._rollouts) else None
        return self._roll(number, to_end=True) if existing is None or existing.qpos is None else existing

    def after(self, cut: int, count: int = AT_CUT, *, beyond: int = 0) -> Counter[str | None]:
        """Return outcome counts of futures of the state before a cut (None: undecided).

        The `count` states differ by what no viewer resolves (UNSEEN_PX, READ_OVER_S), and each count has states of its
        own. beyond: frames after the clip in which what is undecided at its end may settle.
        """
        if (cut, count, beyond) not in self._after:
            self._after[cut, count, beyond] = self._count_after(cut, count, beyond)
        return self._after[cut, count, beyond]

    def _count_after(self, cut: int, count: int, beyond: int) -> Counter[str | None]:
        import mujoco

        model, control = self._prepare.model, self._control
        state, past_qpos = mujoco.MjData(model), np.empty((cut, model.nq))
        state.qvel[:] = self._prepare.velocity
        for i in range(cut):
            if i:
                mujoco.mj_step(model, state, control.physics.substeps)
            past_qpos[i] = state.qpos
        steps = np.random.default_rng([self._seed, count, cut]).normal(size=(count, 2, model.nv))
        unseen_step = unseen_steps(model, state, control.camera)

        def label(step: np.ndarray) -> str | None:
            data = mujoco.MjData(model)
            mujoco.mj_copyData(data, model, state)
            qpos = data.qpos.copy()
            mujoco.mj_integratePos(model, qpos, along_contacts(model, state, step[0] * unseen_step), 1.0)
            data.qpos[:] = qpos
            data.qvel += step[1] * unseen_step * math.sqrt(2) / READ_OVER_S
            frames, outcome = past_qpos, None
            for n_frames in (len(control.qpos) - cut, beyond):
                if outcome is None and n_frames:
                    frames = np.concatenate([frames, np.empty((n_frames, model.nq))])
                    for i in range(len(frames) - n_frames, len(frames)):
                        mujoco.mj_step(model, data, control.physics.substeps)
                        frames[i] = data.qpos
                    outcome = self._settled_label(frames) if np.isfinite(frames).all() else None
            return outcome

        with ThreadPoolExecutor(THREADS) as pool:
            return Counter(pool.map(label, steps))

    def _settled_label(self, frames: np.ndarray) -> str | None:
        """Return the settled outcome of a trajectory (F, nq); None if undecided."""
        control = self._control
        labels = control.family.outcome(replay(self._prepare.model, frames, control.physics), control.params).labels
        return labels[-1] if last_run(labels) <= len(labels) - 1 - self._held_frames else None

    def _roll_all(self, numbers: range) -> list[Rollout]:
        with ThreadPoolExecutor(THREADS) as pool:  # mj_step releases the GIL
            return list(pool.map(self._roll, numbers))

    @cached_property
    def _prepare(self) -> _Prepared:
        import mujoco

        control = self._control
        scene = control.family.build(control.params, control.physics)
        model = scene.spec.compile()
        silhouette, scratch = _Silhouette(model, control.camera), mujoco.MjData(model)
        start = np.asarray(control.qpos[0], float)
        return _Prepared(
            model=model,
            starts=_perturbed_starts(model, start, control.family.perturbation, self._seed),
            velocity=initial_velocity(model, scene.velocity),
            silhouette=silhouette,
            shown=np.stack([silhouette.pixels(row, scratch) for row in control.qpos]),
        )

    def _roll(self, number: int, *, to_end: bool = False) -> Rollout:
        """Simulate one start; give up if it parts before `first`, unless `to_end`."""
        import mujoco

        control, camera_view = self._control, self._prepare
        shown_geoms, outline = camera_view.shown, camera_view.silhouette
        data, scratch = mujoco.MjData(camera_view.model), mujoco.MjData(camera_view.model)
        data.qpos[:], data.qvel[:] = camera_view.starts[number], camera_view.velocity
        frames = np.empty((len(shown_geoms), camera_view.model.nq))
        parted_frame = len(shown_geoms)
        for i in range(len(shown_geoms)):
            frames[i] = data.qpos
            if (
                parted_frame == len(shown_geoms)
                and np.abs(outline.pixels(data.qpos, scratch) - shown_geoms[i]).max() > self._alike_px
            ):
                parted_frame = i
                if i < self.first and not to_end:
                    return Rollout(number, parted_frame, None)
            mujoco.mj_step(camera_view.model, data, control.physics.substeps)
        if not np.isfinite(frames).all():
            return Rollout(number, parted_frame, None)
        return Rollout(number, parted_frame, self._settled_label(frames), frames.astype(np.float32))


def at_cut(rollouts: Sequence[Rollout], frame: int, perturbation: float) -> Cut:
    """Return the cut at a frame, with the outcome counts of its futures."""
    lookalikes = [r for r in rollouts if r.parted >= frame]
    counts = Counter(r.label for r in lookalikes if r.label is not None)
    accepted = counts.total()
    top = max(counts.values(), default=0) / max(accepted, 1)
    return Cut(frame, entropy_bits(counts), top, accepted, len(rollouts), len(lookalikes) - accepted, perturbation)


def twin_of(rollouts: Sequence[Rollout], frame: int, truth: str | None) -> Rollout:
    """Return the first accepted future at a cut that ends in another answer."""
    return next(r for r in rollouts if r.parted >= frame and r.label not in (None, truth))


def deviation_px(model: mujoco.MjModel, camera: Camera, qpos: np.ndarray, twin: np.ndarray) -> float:
    """Return the largest distance (px) between outline points of two trajectories."""
    import mujoco

    silhouette, scratch = _Silhouette(model, camera), mujoco.MjData(model)
    pairs = ((silhouette.pixels(a, scratch), silhouette.pixels(b, scratch)) for a, b in zip(qpos, twin, strict=True))
    return max(float(np.abs(a - b).max()) for a, b in pairs)


def _perturbed_starts(model: mujoco.MjModel, start: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """Return TRIED starts, (TRIED, nq): a normal step on every degree of freedom."""
    import mujoco

    steps = np.random.default_rng([seed, TRIED]).normal(scale=scale, size=(TRIED, model.nv))
    starts = np.tile(start, (TRIED, 1))
    for row, step in zip(starts, steps, strict=True):
        mujoco.mj_integratePos(model, row, step, 1.0)
    return starts


def unseen_steps(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> np.ndarray:
    """Return the invisible step (m, rad) of each degree of freedom, (nv,).

    It is one standard deviation: a body moves by UNSEEN_PX, and turns by so much at its furthest point.
    """
    import mujoco

    scales = np.empty(model.nv)
    for joint_id in range(model.njnt):
        body, dof = model.jnt_bodyid[joint_id], int(model.jnt_dofadr[joint_id])
        geoms = model.geom_bodyid == body
        metres = UNSEEN_PX * camera.metres_a_pixel(data.xpos[body])
        radians = metres / (np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]).max()
        kind = model.jnt_type[joint_id]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            scales[dof : dof + 6] = [metres] * 3 + [radians] * 3
        else:
            scales[dof] = radians if kind == mujoco.mjtJoint.mjJNT_HINGE else metres
    return scales


def along_contacts(model: mujoco.MjModel, data: mujoco.MjData, step: np.ndarray) -> np.ndarray:
    """Return a step (nv,) without its parts that push free bodies into or off contacts."""
    normals: dict[int, list[np.ndarray]] = {}
    for contact in data.contact[: data.ncon]:
        for geom in contact.geom:
            normals.setdefault(int(model.geom_bodyid[geom]), []).append(contact.frame[:3])
    along = step.copy()
    for body, contact_normals in normals.items():
        if model.body_dofnum[body] == 6:
            dof = int(model.body_dofadr[body])
            directions = np.array(contact_normals)
            along[dof : dof + 3] -= np.linalg.pinv(directions) @ directions @ along[dof : dof + 3]
    return along


class _Silhouette:
    """Points by which two poses differ to the eye: boxes, balls' outlines, vertices.

    A ball's outline does not turn with the ball: its spin cannot be seen.
    """

    def __init__(self, model: mujoco.MjModel, camera: Camera) -> None:
        import mujoco

        self._model, self._camera = model, camera
        moving_geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0)
        ball = model.geom_type[moving_geoms] == mujoco.mjtGeom.mjGEOM_SPHERE
        self._balls, self._solids = moving_geoms[ball], moving_geoms[~ball]
        signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T
        boxes = model.geom_aabb[self._solids]
        self._corners = boxes[:, None, :3] + signs * boxes[:, None, 3:]
        right, up, _ = camera.axes()
        outline = np.stack([right, -right, up, -up])
        self._outline = model.geom_size[self._balls, :1, None] * outline

    def pixels(self, qpos: np.ndarray, data: mujoco.MjData) -> np.ndarray:
        """Return pixel coordinates of all outline points in one pose, shape (N, 2).

        data: scratch space of the model, one for each thread, since making it takes longest.
        """
        import mujoco

        data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, data)
        rotation = data.geom_xmat[self._solids].reshape(-1, 3, 3)
        corners = np.einsum("gij,gkj->gki", rotation, self._corners) + data.geom_xpos[self._solids, None]
        outline = self._outline + data.geom_xpos[self._balls, None]
        soft_vertices = [flex_vertices(self._model, data, flex) for flex in range(self._model.nflex)]
        return self._camera.project(np.concatenate([corners.reshape(-1, 3), outline.reshape(-1, 3), *soft_vertices]))
