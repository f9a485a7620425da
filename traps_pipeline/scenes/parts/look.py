"""Vary a scene's look: floor, light, occluder, bystanders, camera, frame size.

A look is a value that is drawn with a scenario and stored with its parameters, as `look`; a record without one looks as
scenes did before there were looks. It touches nothing that moves, so the trajectory is the same; camera, occluder and
certificates are computed under it like everything else.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from traps_pipeline.scenes.parts.floor import PALE_TONES, TEXELS, TONES, floors, lay_floor
from traps_pipeline.scenes.physics.kit import COLOURS, Scene, uniform
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH
from traps_pipeline.scenes.picture.render import SUPERSAMPLE

if TYPE_CHECKING:
    import mujoco

# What may vary, as `traps benchmark sample --look` names it.
PARTS = ("floor", "pale-floor", "light", "panel", "bystanders", "camera", "material", "size")
OCCLUSION_PARTS = ("bystanders", "camera", "light", "material", "pale-floor", "panel")  # of a family that says nothing
# Colours of the occluder (sRGB): dark, dull, and none that a question names or that is taken for one in another light.
OCCLUDERS: Mapping[str, tuple[float, float, float]] = {
    "navy": COLOURS["navy"],
    "maroon": (0.30, 0.16, 0.18),
    "olive": (0.29, 0.29, 0.18),
    "petrol": (0.13, 0.22, 0.24),
    "umber": (0.27, 0.22, 0.18),
}
# What the occluder is of, besides its colour: thin lines, paler by so much, at so many to the metre and so wide.
MATERIALS = ("plain", "slats", "tiles")
LINE_TONE, LINES_PER_M, LINE_SHARE = 1.6, 8.0, 0.08
SIZES = {"360p": 1, "720p": 2}  # of a frame: how many times as fine as 480x360
_FLOORS = {"pale-floor": floors(PALE_TONES), "floor": floors()}  # the first that is named counts
_FLOOR_FIELDS = ("floor_pattern", "floor_tones", "floor_repeat_m", "floor_turn_deg", "floor_shift_m")
BYSTANDERS = (0, 0, 2, 3)  # how many stand there: none in half of the scenes
BEHIND_M = (0.25, 0.9)  # so far behind all that is shown a bystander stands: it hides nothing and shades nothing


@dataclass(frozen=True)
class Look:
    """The look of a scene; a field that is None or empty changes nothing.

    floor_*: see `parts.floor`. light_turn_deg: turn of the key light about the vertical; light: factors of its
    brightness, RGB. panel: a name of `OCCLUDERS`. bystanders: (across, behind, half width, half height) in metres,
    from the middle of the back edge of what is shown, and a tone each. orbit_deg: turn of the camera, around and up.
    material: the occluder's, a name of `MATERIALS`. size: the frame's, a name of `SIZES`.
    """

    floor_pattern: str | None = None
    floor_tones: tuple[str, ...] = ()
    floor_repeat_m: float = 1.0
    floor_turn_deg: float = 0.0
    floor_shift_m: tuple[float, ...] = (0.0, 0.0)
    light_turn_deg: float = 0.0
    light: tuple[float, ...] = (1.0, 1.0, 1.0)
    panel: str | None = None
    bystanders: tuple[tuple[float, ...], ...] = ()
    bystander_tones: tuple[str, ...] = ()
    orbit_deg: tuple[float, ...] = (0.0, 0.0)
    material: str = "plain"
    size: str = "360p"

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Look:
        """Return the look in a record's parameters. Raises ValueError."""
        try:
            look = Look(**{name: _tuples(value) for name, value in record.items()})
        except TypeError as error:
            raise ValueError(f"look: {error}") from None
        for name in (*look.floor_tones, *look.bystander_tones):
            if name not in TONES:
                raise ValueError(f"look: no tone {name!r}; there are {', '.join(TONES)}")
        if look.panel not in (None, *OCCLUDERS):
            raise ValueError(f"look: no panel {look.panel!r}; there are {', '.join(OCCLUDERS)}")
        for name, allowed_values in (("material", MATERIALS), ("size", SIZES)):
            if getattr(look, name) not in allowed_values:
                raise ValueError(f"look: no {name} {getattr(look, name)!r}; there are {', '.join(allowed_values)}")
        return look


def look_of_draw(seed: int, family: str, number: int, parts: Collection[str]) -> Look | None:
    """Return the look of a numbered draw of a family, drawn independently of the scene."""
    return draw_look(np.random.default_rng([seed, *family.encode(), number, *b"look"]), parts)


def draw_look(rng: np.random.Generator, parts: Collection[str]) -> Look | None:
    """Return a look that varies in some of `PARTS`; None if there are none."""
    if not parts:
        return None
    fields_drawn: dict[str, Any] = {}
    floor = next((floor for part, floor in _FLOORS.items() if part in parts), None)
    if floor is not None:
        fields_drawn |= dict(zip(_FLOOR_FIELDS, floor.draw(rng, {}, len(_FLOOR_FIELDS)), strict=True))
    if "light" in parts:
        brightness, warmth = uniform(rng, 0.8, 1.1), uniform(rng, -0.06, 0.06)
        fields_drawn["light_turn_deg"] = uniform(rng, -15, 15)
        fields_drawn["light"] = tuple(round(brightness * (1 + tint), 3) for tint in (warmth, 0.0, -warmth))
    if "panel" in parts:
        fields_drawn["panel"] = str(rng.choice(list(OCCLUDERS)))
    if "bystanders" in parts:
        places = [
            (uniform(rng, -0.9, 0.9), uniform(rng, *BEHIND_M), uniform(rng, 0.04, 0.12), uniform(rng, 0.04, 0.2))
            for _ in range(int(rng.choice(BYSTANDERS)))
        ]
        fields_drawn["bystanders"] = tuple(places)
        fields_drawn["bystander_tones"] = tuple(str(tone) for tone in rng.choice(list(TONES), len(places)))
    if "camera" in parts:
        fields_drawn["orbit_deg"] = (uniform(rng, -8, 8), uniform(rng, -4, 4))
    if "material" in parts:
        fields_drawn["material"] = str(rng.choice(MATERIALS))
    if "size" in parts:
        fields_drawn["size"] = "720p"  # of all alike: a size that varied would be a cue
    return Look(**fields_drawn)


# --- parameters that have one -----------------------------------------------------------------------------------------


def look_of(params: Any) -> Look | None:
    """Return the look of a scene's parameters, None if they have none."""
    return getattr(params, "look", None)


def fineness(params: Any) -> int:
    """Return the factor by which a scene's frames are larger than 480x360."""
    look = look_of(params)
    return 1 if look is None else SIZES[look.size]


def frame_size(record: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height (px) of the clips of a record, from its parameters."""
    look = record.get("look")
    scale = 1 if look is None else SIZES[Look.from_record(look).size]
    return WIDTH * scale, HEIGHT * scale


def occluder_texture(colour: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return an occluder's texture, uint8 (..., 3): its colour (sRGB), paler where `line` (...) is true."""
    tone = np.where(line[..., None], np.minimum(1.0, LINE_TONE * colour + 0.06), colour)
    return np.rint(255 * tone).astype(np.uint8)


def paint_occluders(spec: mujoco.MjSpec, occluders: Sequence[mujoco.MjsGeom], params: Any) -> None:
    """Give occluders of one size the look's colour and material."""
    import mujoco

    look = look_of(params)
    colour = OCCLUDERS["navy" if look is None or look.panel is None else look.panel]
    for geom in occluders:
        geom.rgba = [*colour, 1.0]
    if look is None or look.material == "plain":
        return
    down, right = np.mgrid[:TEXELS, :TEXELS] / TEXELS
    line = (down < LINE_SHARE) | ((right < LINE_SHARE) & (look.material == "tiles"))
    texture = spec.add_texture(name="occluder", type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.width = texture.height = TEXELS
    texture.nchannel = 3
    texture.data = occluder_texture(np.array(colour), line).tobytes()
    material = spec.add_material(name="occluder", specular=0.0, shininess=0.0, reflectance=0.0, rgba=[1, 1, 1, 1])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "occluder"
    material.texuniform, material.texrepeat = True, [LINES_PER_M] * 2
    for geom in occluders:
        geom.material, geom.rgba = "occluder", [1, 1, 1, 1]
        # A texture lies in a box's own x and y: stand it up.
        width, thickness, height = (float(half_size) for half_size in geom.size)
        cos, _, _, sin = (float(part) for part in geom.quat)
        geom.size, geom.quat = [width, height, thickness], [part / np.sqrt(2) for part in (cos, cos, sin, sin)]


def apply_look(scene: Scene, look: Look | None) -> Scene:
    """Apply a look to a built scene; return the scene."""
    if look is None:
        return scene
    if look.floor_pattern is not None:
        lay_floor(scene.spec, SimpleNamespace(**{name: getattr(look, name) for name in _FLOOR_FIELDS}))
    _light(scene, look)
    _add_bystanders(scene, look)
    if SIZES[look.size] > 1:  # a renderer reads from the model how fine it draws
        scale = SUPERSAMPLE * SIZES[look.size]
        scene.spec.visual.global_.offwidth, scene.spec.visual.global_.offheight = WIDTH * scale, HEIGHT * scale
    azimuth_turn, elevation_turn = look.orbit_deg
    view = scene.view
    return replace(
        scene,
        view=replace(
            view, azimuth_deg=view.azimuth_deg + azimuth_turn, elevation_deg=view.elevation_deg + elevation_turn
        ),
    )


def _light(scene: Scene, look: Look) -> None:
    key = scene.spec.light("key")
    turn = np.radians(look.light_turn_deg)
    x, y, z = (float(value) for value in key.dir)
    key.dir = [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z]
    key.diffuse = [float(value) for value in np.multiply(key.diffuse, look.light)]


def _add_bystanders(scene: Scene, look: Look) -> None:
    """Add boxes on the floor behind everything, without contact."""
    import mujoco

    corners = np.concatenate([box.corners() for box in (*scene.framed, *([scene.cover] if scene.cover else []))])
    middle, back = float(corners[:, 0].mean()), float(corners[:, 1].max())
    for i, (place, tone) in enumerate(zip(look.bystanders, look.bystander_tones, strict=True)):
        across, distance_behind, half_width, half_height = place
        box = scene.spec.worldbody.add_geom(name=f"bystander_{i}", type=mujoco.mjtGeom.mjGEOM_BOX)
        box.pos, box.size = (
            [middle + across, back + distance_behind + half_width, half_height],
            [half_width, half_width, half_height],
        )
        box.rgba, box.contype, box.conaffinity = [*TONES[tone], 1], 0, 0


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value
