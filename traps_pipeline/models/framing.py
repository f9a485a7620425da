"""Which frames of a clip a model is shown in a dataset that varies them (docs/hypotheses.md)."""

from __future__ import annotations

from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.video.policies import FramePolicy

_RATES = {"frames_few": 2, "frames_all": 10}  # frames a second
_LATER = {"frames_later": 1}  # frames of the clip
CLIP_S = 5  # of a whole clip (docs/spec.md 2)


def framed(spec: MediaSpec, dataset: str) -> MediaSpec:
    """Return how a model is shown the clips of a dataset: as its entry says, or with other frames."""
    if dataset in _RATES:
        rate = _RATES[dataset]
        return spec.model_copy(update={"fps": float(rate), "uniform": None, "most": rate * CLIP_S})
    return spec.model_copy(update={"later": _LATER[dataset]}) if dataset in _LATER else spec


def observed(dataset: str) -> FramePolicy:
    """Return the frames from which the observer answers: 5 a second, or as the dataset varies them."""
    spec = framed(MediaSpec(profile="frames", fps=5), dataset)
    return FramePolicy(spec.fps, spec.uniform, spec.most, spec.later)
