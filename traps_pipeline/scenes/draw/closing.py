"""Close controls: once the outcome has settled, an occluder enters before it and stays.

In an occlusion scene the occluder is the void's. In a chaotic scene it stands before the place of all outcomes and
before whatever moves in either world. Every control closes that can (docs/design/twins.md).
"""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from traps_pipeline.scenes.certification.certificates import CLOSING, LEGIBLE, ORDER, certificates_for
from traps_pipeline.scenes.certification.evidence import Pair, VoidKind, require_certificates
from traps_pipeline.scenes.physics.simulate import standing_points, swept_points
from traps_pipeline.scenes.picture.camera import Closing, Occluder, fit_occluder
from traps_pipeline.scenes.worlds.outcome import Rejected
from traps_pipeline.scenes.worlds.pace import moments
from traps_pipeline.scenes.worlds.shot import box_around
from traps_pipeline.scenes.worlds.world import World


def close_control(pair: Pair, seed: int, evidence: Mapping[str, Any]) -> tuple[Pair, dict[str, Any]]:
    """Return the pair whose control an occluder closes at a moment drawn by seed, and evidence. Raises Rejected."""
    worlds = pair.control, pair.other_world
    for frame in moments(worlds[:1] if pair.control.occluder is None else worlds, seed):
        try:
            return _certify(pair, Closing(frame, occluder_from(frame, *worlds)), evidence)
        except Rejected:
            continue  # another moment may do
    return _certify(pair, None, evidence)


def _certify(pair: Pair, closing: Closing | None, evidence: Mapping[str, Any]) -> tuple[Pair, dict[str, Any]]:
    """Return a pair whose control ends like this, and all evidence. Raises Rejected."""
    control, twin = replace(pair.control, closing=closing), replace(pair.other_world, closing=closing)
    ending = replace(pair, control=control, twin=twin)
    void_kind: VoidKind = "truncation" if control.occluder is None else "occluder"
    certificates = (LEGIBLE, ORDER, CLOSING, *certificates_for(void_kind, "worlds"))
    return ending, require_certificates(certificates, ending, evidence)


def record_of(pair: Pair) -> dict[str, Any] | None:
    """Return the closing of a control (from when an occluder stands) as its record stores it; None without."""
    closing = pair.control.closing
    if closing is None:
        return None
    occluder = {} if pair.control.occluder is not None else {"panel": asdict(closing.occluder)}
    return {"closes_frame": closing.frame, **occluder}


def occluder_from(frame: int, control: World, *others: World) -> Occluder:
    """Return the void's occluder, or one that hides all outcomes and all that moves from a frame on."""
    if control.occluder is not None:
        return control.occluder
    boxes = control.scene.framed if control.scene.rest is None else (control.scene.rest,)
    swept_corners = [swept_points(world.model, world.qpos[frame:]) for world in (control, *others)]
    cover = box_around([*swept_corners, *(box.corners() for box in boxes)])
    return fit_occluder(control.camera, cover, standing_points(control.model, control.qpos[-1]))
