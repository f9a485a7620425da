"""Choose the frames shown in a dataset that varies them (docs/hypotheses.md), and the size of wide clips."""

from traps_pipeline.protocol.datasets import TWO_EVENTS
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDE, WIDTH
from traps_pipeline.storage.media import MediaSpec
from traps_pipeline.video.policies import FramePolicy

_RATES = {"frames_few": 2, "frames_all": 10}  # frames a second
_LATER = {"frames_later": 1}  # frames of the clip
CLIP_S = 5  # duration of a whole clip (docs/spec.md 2)
CELL_PX = 16  # sizes are whole multiples of it, as processors want them


def clip_size(dataset: str) -> tuple[int, int]:
    """Return width and height of a dataset's clips (px)."""
    return (WIDE if dataset == TWO_EVENTS else WIDTH), HEIGHT


def media_for_dataset(spec: MediaSpec, dataset: str) -> MediaSpec:
    """Return a dataset's media settings: the entry's, or with other frames.

    Where an entry gives a size, a wide clip gets as many pixels in its own shape; what is cropped to a size otherwise
    is stretched to it, so that no lane is cut off.
    """
    if dataset == TWO_EVENTS and spec.size is not None:
        if spec.fit == "crop":
            return spec.model_copy(update={"fit": "stretch"})
        wider = (WIDE / WIDTH) ** 0.5
        sides = (spec.size[0] * wider, spec.size[1] / wider)
        return spec.model_copy(update={"size": tuple(max(CELL_PX, int(side) // CELL_PX * CELL_PX) for side in sides)})
    if dataset in _RATES:
        rate = _RATES[dataset]
        return spec.model_copy(update={"fps": float(rate), "uniform": None, "most": rate * CLIP_S})
    return spec.model_copy(update={"later": _LATER[dataset]}) if dataset in _LATER else spec


def observer_frames(dataset: str) -> FramePolicy:
    """Return the policy by which the observer's frames are picked: 5 a second, or the dataset's."""
    spec = media_for_dataset(MediaSpec(profile="frames", fps=5), dataset)
    return FramePolicy(spec.fps, spec.uniform, spec.most, spec.later)
