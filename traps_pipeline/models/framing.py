"""Choose the frames shown in a dataset that varies them (docs/hypotheses.md)."""

from __future__ import annotations

from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.video.policies import FramePolicy

_RATES = {"frames_few": 2, "frames_all": 10}  # frames a second
_LATER = {"frames_later": 1}  # frames of the clip
CLIP_S = 5  # duration of a whole clip (docs/spec.md 2)


def media_for_dataset(spec: MediaSpec, dataset: str) -> MediaSpec:
    """Return a dataset's media settings: the entry's, or with other frames."""
    if dataset in _RATES:
        rate = _RATES[dataset]
        return spec.model_copy(update={"fps": float(rate), "uniform": None, "most": rate * CLIP_S})
    return spec.model_copy(update={"later": _LATER[dataset]}) if dataset in _LATER else spec


def observer_frames(dataset: str) -> FramePolicy:
    """Return the frames that the observer sees: 5 a second, or the dataset's."""
    spec = media_for_dataset(MediaSpec(profile="frames", fps=5), dataset)
    return FramePolicy(spec.fps, spec.uniform, spec.most, spec.later)
