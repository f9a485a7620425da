"""Certify a record from its two trajectories alone.

`certificates` defines them; `docs/scenes.md` says what each promises and what it does not.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from traps_pipeline.scenes.certification.certificates import certificates_for, pair_of
from traps_pipeline.scenes.certification.evidence import Pair
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.spec import SceneSpec
from traps_pipeline.video.encode import frames_digest


@dataclass(frozen=True)
class Verdict:
    """The result of certifying a record: failed certificates, evidence and measurements.

    failures: certificate -> why it cannot be given; empty if the record passes. measured: the evidence of all
    certificates. same_physics: whether simulating here gives the frozen trajectory bit by bit. control_end, void_end:
    digests of the clips' last frames; where these differ between scenarios the clips differ. at_cut: what moves at the
    end of a void that is cut (`state_at_cut`); empty where an occluder makes the void.
    """

    scenario_id: str
    family: str
    failures: Mapping[str, str]
    measured: Mapping[str, Any]
    same_physics: bool
    control_end: str = ""
    void_end: str = ""
    at_cut: Sequence[float] = ()
    cpu_s: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether every certificate is given."""
        return not self.failures


def certify(spec: SceneSpec, qpos: np.ndarray, twin: np.ndarray, *, frame_step: int = 1) -> Verdict:
    """Return the verdict on a record: all its certificates, measured from its trajectories, (F, nq).

    The measured evidence must also equal the stored evidence. frame_step: pixel certificates look at every so
    many frames (1: full rate; 2: the 5 FPS sample).
    """
    start_s = time.process_time()
    pair = pair_of(spec, qpos, twin, frame_step=frame_step)
    same_physics = _is_same_physics(pair)
    failures: dict[str, str] = {}
    evidence_so_far: dict[str, Any] = {}
    for certificate in certificates_for(spec.void_kind):
        try:
            evidence = certificate.measured(pair)
        except Rejected as impossible:
            failures[certificate.name] = str(impossible)
            continue
        evidence_so_far |= evidence
        failure = certificate.failure(evidence_so_far, pair.claim)
        failure = failure or certificate.contradiction(evidence, spec.evidence, exact=same_physics)
        if failure is not None:
            failures[certificate.name] = failure
    control_end, void_end = _last_frames(pair)
    return Verdict(
        scenario_id=spec.scenario_id,
        family=spec.family,
        failures=failures,
        measured=evidence_so_far,
        same_physics=same_physics,
        control_end=control_end,
        void_end=void_end,
        at_cut=state_at_cut(qpos, pair.void_from).tolist() if spec.void_kind == "truncation" else [],
        cpu_s=time.process_time() - start_s,
    )


def state_at_cut(qpos: np.ndarray, cut_frame: int) -> np.ndarray:
    """Return the last poses of a cut void, and their last change, shape (2 nq,)."""
    last, previous_pose = qpos[cut_frame - 1], qpos[max(cut_frame - 2, 0)]  # a void of one frame shows no change
    return np.concatenate([last, last - previous_pose])


def _is_same_physics(pair: Pair) -> bool:
    try:
        return pair.control.same_physics
    except Rejected:  # the certificate `physics` says why
        return False


def _last_frames(pair: Pair) -> tuple[str, str]:
    """Return digests of the last frame of the control and of the void."""
    control, last = pair.control, len(pair.control.qpos) - 1
    if control.occluder is not None and control.closing is not None:
        (end,) = control.behind_occluder([last])
        return frames_digest([end]), frames_digest([end])
    with control.closed_renderer() as renderer:
        end = list(renderer.frames(control.qpos[-1:], occluder=control.closing is not None))
        if control.occluder is not None:
            void = renderer.frames(control.qpos[-1:], occluder=True)
        else:
            void = renderer.frames(control.qpos[pair.void_from - 1 : pair.void_from])
        return frames_digest(end), frames_digest(list(void))
