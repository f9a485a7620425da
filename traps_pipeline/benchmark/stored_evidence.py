"""Check records' stored evidence against certificates, in each scene_specs stage.

The evidence was measured when the scenario was resolved; `scenes.certification.certify_record` measures it again from
the trajectories.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from traps_pipeline.scenes.certification.certificates import certificates_for, pair_of, stored_evidence
from traps_pipeline.scenes.certification.evidence import About, Certificate, Claim
from traps_pipeline.scenes.worlds.spec import SceneSpec

_NO_FRAMES = np.empty((0, 0), np.float32)  # words are certified without a trajectory


def failed_certificates(specs: Iterable[SceneSpec], *about: About) -> list[str]:
    """Return a sentence for each certificate about these subjects that the stored evidence fails."""
    judged = ((spec.scenario_id, *parts) for spec in specs for parts in judged_certificates(spec, *about))
    return [f"{id_}: {certificate.name}: {failure}" for id_, certificate, _, failure in judged if failure is not None]


def judged_certificates(spec: SceneSpec, *about: About) -> Iterator[tuple[Certificate, Mapping[str, Any], str | None]]:
    """Yield a record's certificates (`about`: those of some subjects), their evidence, and why each fails or None."""
    record_evidence, claim = stored_evidence(spec), Claim.of_record(spec)
    for certificate in certificates_for(spec.void_kind, *about):
        is_words = certificate.about == "words"
        evidence = certificate.measured(pair_of(spec, _NO_FRAMES, _NO_FRAMES)) if is_words else record_evidence
        yield certificate, evidence, certificate.failure(evidence, claim)
