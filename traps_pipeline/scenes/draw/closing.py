"""How a control ends: some time after its outcome has settled, a panel comes before it and stands to the end.

So the last frame tells nobody the answer, and a model must have watched. In an occlusion scene the panel is that of the
void, where the void has it: control and void then end in the same frames, and the last frame does not tell the one from
the other. In a chaotic scene it stands before the place where all outcomes lie, and before whatever moves in either
world, so that its place tells nothing of the answer.

Every control closes that can: drawn among them, a panel at the end would tell something of the side after all.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from traps_pipeline.scenes.certification.certificates import CLOSING, LEGIBLE, ORDER, READ_S
from traps_pipeline.scenes.certification.evidence import Pair, required
from traps_pipeline.scenes.parts.readings import still_from
from traps_pipeline.scenes.physics.kit import Box
from traps_pipeline.scenes.physics.simulate import swept_points
from traps_pipeline.scenes.picture.camera import Closing, Panel, fit_panel
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.world import World
from traps_pipeline.video.policies import last_of_all

READ_BY_DRAW_S = 1.0  # so long the outcome is in view where there is time for it
REST_BY_DRAW_S = 0.6  # so long it has been at rest by then: three frames of five a second
STILL_M = 0.005  # a pixel or two
BESIDE_M = 0.03  # from the middle of a body to the points by which it is seen to turn
TRIES = 4  # moments at which it is tried to close a control


def closed(pair: Pair, seed: int, so_far: Mapping[str, Any]) -> tuple[Pair, dict[str, Any]]:
    """A pair whose control closes, at a moment that follows from the seed, with the evidence of it; the pair as it is
    if its control can be closed at no moment that is tried. so_far: the evidence of all other certificates. Raises
    Rejected if not even that can be certified."""
    worlds = pair.control, pair.other_world
    for frame in moments(pair.control, seed):
        try:
            return _certified(pair, Closing(frame, panel_from(frame, *worlds)), so_far)
        except Rejected:
            continue  # another moment may do
    return _certified(pair, None, so_far)


def _certified(pair: Pair, closing: Closing | None, so_far: Mapping[str, Any]) -> tuple[Pair, dict[str, Any]]:
    """A pair whose control ends like this, with all evidence. Raises Rejected."""
    control, twin = replace(pair.control, closing=closing), replace(pair.other_world, closing=closing)
    ending = replace(pair, control=control, twin=twin)
    return ending, required((LEGIBLE, ORDER, CLOSING), ending, so_far)


def record_of(pair: Pair) -> dict[str, Any] | None:
    """How the control closes, as a record has it."""
    closing = pair.control.closing
    if closing is None:
        return None
    own = {} if pair.control.panel is not None else {"panel": asdict(closing.panel)}
    return {"closes_frame": closing.frame, **own}


def moments(control: World, seed: int) -> Iterator[int]:
    """Frames at which a control may close: when the outcome has been in view, and at rest, for long enough; where there
    is no time for that, and after all others, the last frame that is possible. None where no frame is."""
    fps, commit = control.physics.fps, control.outcome.commit_frame
    last = last_of_all(len(control.qpos), fps)
    if last - commit < round(READ_S * fps):
        return
    rests = _at_rest_from(control) + round(REST_BY_DRAW_S * fps)
    first = min(max(commit + round(READ_BY_DRAW_S * fps), rests), last)
    rng = np.random.default_rng([seed, *control.family.name.encode(), *b"closing"])
    drawn = [int(frame) for frame in rng.permutation(np.arange(first, last + 1))]
    yield from dict.fromkeys([*drawn[: TRIES - 1], last])


def _at_rest_from(control: World) -> int:
    """The frame from which every decisive body stays as it lies at the end: its middle, and three points around it."""
    motion = control.motion
    paths = [motion.places(body, BESIDE_M) for body in control.scene.decisive]
    return still_from(*paths, within_m=STILL_M)


def panel_from(frame: int, control: World, *others: World) -> Panel:
    """The panel that closes a control at a frame: that of its void, or one in front of where all outcomes lie and of
    all that moves from then on, in the control and in other worlds that it must not be told from."""
    if control.panel is not None:
        return control.panel
    zone = control.scene.framed if control.scene.rest is None else (control.scene.rest,)
    moving = [swept_points(world.model, world.qpos[frame:]) for world in (control, *others)]
    hidden = np.concatenate([*moving, *(box.corners() for box in zone)])
    return fit_panel(control.camera, Box(_corner(hidden.min(axis=0)), _corner(hidden.max(axis=0))))


def _corner(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
