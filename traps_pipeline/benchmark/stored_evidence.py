"""Check records' stored evidence against certificates, in each scene_specs stage.

The evidence was measured when the scenario was resolved; `scenes.certification.certify_record` measures it again from
the trajectories.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from traps_pipeline.scenes.certification.certificates import certificates_for, pair_of, stored_evidence
from traps_pipeline.scenes.certification.evidence import About, Claim
from traps_pipeline.scenes.worlds.spec import SceneSpec

_NO_FRAMES = np.empty((0, 0), np.float32)  # words are certified without a trajectory


def unanswerable_controls(specs: Iterable[SceneSpec]) -> list[str]:
    """Return control certificates that the stored evidence fails, one sentence each."""
    return list(_lost_certificates(specs, "control"))


def answerable_voids(specs: Iterable[SceneSpec]) -> list[str]:
    """Return void certificates that the stored evidence fails, one sentence each."""
    return list(_lost_certificates(specs, "void", "twin", "worlds"))


def _lost_certificates(specs: Iterable[SceneSpec], *about: About) -> Iterator[str]:
    for spec in specs:
        evidence, claim = stored_evidence(spec), Claim.of_record(spec)
        for certificate in certificates_for(spec.void_kind, *about):
            failure = certificate.failure(evidence, claim)
            if failure is not None:
                yield f"{spec.scenario_id}: {certificate.name}: {failure}"


def answerable_ill_posed(specs: Iterable[SceneSpec]) -> list[str]:
    """Return problems of ill-posed questions: unrefuted, or well-posed ones refuted."""
    problems = []
    for spec in specs:
        pair = pair_of(spec, _NO_FRAMES, _NO_FRAMES)
        for certificate in certificates_for(spec.void_kind, "words"):
            failure = certificate.failure(certificate.measured(pair), pair.claim)
            if failure is not None:
                problems.append(f"{spec.scenario_id}: {failure}")
    return problems
