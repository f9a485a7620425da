"""How a control ends: some time after its outcome has settled, an occluder comes before it and stands to the end.

So the last frame tells nobody the answer, and a model must have watched. In an occlusion scene the occluder is that of
the void, where the void has it: control and void then end in the same frames, and the last frame does not tell the one
from the other. In a chaotic scene it stands before the place where all outcomes lie, and before whatever moves in
either world, so that its place tells nothing of the answer.

Every control closes that can: drawn among them, an occluder at the end would tell something of the side after all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from traps_pipeline.scenes.certification.certificates import CLOSING, LEGIBLE, ORDER, certificates_for
from traps_pipeline.scenes.certification.evidence import Pair, VoidKind, required
from traps_pipeline.scenes.physics.simulate import swept_points
from traps_pipeline.scenes.picture.camera import Closing, Occluder, fit_occluder
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.pace import moments
from traps_pipeline.scenes.worlds.shot import box_around
from traps_pipeline.scenes.worlds.world import World


def closed(pair: Pair, seed: int, so_far: Mapping[str, Any]) -> tuple[Pair, dict[str, Any]]:
    """Return a pair whose control closes, at a moment that follows from the seed, with the evidence of it; the pair as
    it is if its control can be closed at no moment that is tried. so_far: the evidence of all other certificates.
    Raises Rejected if not even that can be certified."""
    worlds = pair.control, pair.other_world
    for frame in moments(worlds[:1] if pair.control.occluder is None else worlds, seed):
        try:
            return _certified(pair, Closing(frame, occluder_from(frame, *worlds)), so_far)
        except Rejected:
            continue  # another moment may do
    return _certified(pair, None, so_far)


def _certified(pair: Pair, closing: Closing | None, so_far: Mapping[str, Any]) -> tuple[Pair, dict[str, Any]]:
    """Return a pair whose control ends like this, with all evidence. Raises Rejected."""
    control, twin = replace(pair.control, closing=closing), replace(pair.other_world, closing=closing)
    ending = replace(pair, control=control, twin=twin)
    kind: VoidKind = "truncation" if control.occluder is None else "occluder"
    certificates = (LEGIBLE, ORDER, CLOSING, *certificates_for(kind, "worlds"))
    return ending, required(certificates, ending, so_far)


def record_of(pair: Pair) -> dict[str, Any] | None:
    """Return how the control closes, as a record has it."""
    closing = pair.control.closing
    if closing is None:
        return None
    own = {} if pair.control.occluder is not None else {"panel": asdict(closing.occluder)}
    return {"closes_frame": closing.frame, **own}


def occluder_from(frame: int, control: World, *others: World) -> Occluder:
    """Return the occluder that closes a control at a frame: that of its void, or one in front of where all outcomes lie
    and of all that moves from then on, in the control and in other worlds that it must not be told from."""
    if control.occluder is not None:
        return control.occluder
    zone = control.scene.framed if control.scene.rest is None else (control.scene.rest,)
    moving = [swept_points(world.model, world.qpos[frame:]) for world in (control, *others)]
    return fit_occluder(control.camera, box_around([*moving, *(box.corners() for box in zone)]))
