"""Check the evidence that records carry against the certificates.

The scene_specs stage does so each time.

The evidence was measured when the scenario was resolved; `scenes.certification.certify_record` measures it again from
the trajectories.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from traps_pipeline.scenes.certification.certificates import certificates_for, pair_of, stored_evidence
from traps_pipeline.scenes.certification.evidence import About, Claim
from traps_pipeline.scenes.worlds.spec import SceneSpec

_NO_FRAMES = np.empty((0, 0), np.float32)  # words are certified without a trajectory


def unanswerable_controls(specs: Iterable[SceneSpec]) -> list[str]:
    """Return records whose evidence does not certify the control.

    One sentence per lost certificate.
    """
    return list(_lost_certificates(specs, "control"))


def answerable_voids(specs: Iterable[SceneSpec]) -> list[str]:
    """Return records whose evidence does not certify the void.

    One sentence per lost certificate.
    """
    return list(_lost_certificates(specs, "void", "twin", "worlds"))


def _lost_certificates(specs: Iterable[SceneSpec], *about: About) -> Iterator[str]:
    for spec in specs:
        evidence, claim = stored_evidence(spec), Claim.of_record(spec)
        for certificate in certificates_for(spec.void_kind, *about):
            failure = certificate.failure(evidence, claim)
            if failure is not None:
                yield f"{spec.scenario_id}: {certificate.name}: {failure}"


def answerable_ill_posed(specs: Iterable[SceneSpec]) -> list[str]:
    """Return records whose ill-posed question the video may answer.

    Evidence must refute it, and must not refute the well-posed one.
    """
    problems = []
    for spec in specs:
        pair = pair_of(spec, _NO_FRAMES, _NO_FRAMES)
        for certificate in certificates_for(spec.void_kind, "words"):
            failure = certificate.failure(certificate.measured(pair), pair.claim)
            if failure is not None:
                problems.append(f"{spec.scenario_id}: {failure}")
    return problems
