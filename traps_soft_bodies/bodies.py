"""Add soft bodies to a course: a rope, a cloth and a ball.

Each is one of MuJoCo's flexes, by whose name it is called in the roles of a scene; its family reads it by
`motion.vertices`. Places are those of `parts.course`. A scene with one is integrated with MuJoCo's `discrete`
integrator, the only one that takes elasticity implicitly, and its air is thick enough to brake what is light, or a rope
would sway to the end of the clip (docs/engineering-notes.md, "Physics").
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from traps_pipeline.scenes.parts.course import Course
from traps_pipeline.scenes.physics.kit import Vec3, rgba

if TYPE_CHECKING:
    import mujoco


def rope(
    course: Course,
    name: str,
    middle: Vec3,
    length: float,
    radius: float,
    colour: str,
    *,
    thrown: tuple[float, float],
    mass: float = 0.15,
    links: int = 24,
    sliding: float = 0.6,
    drag: float = 0.1,
) -> mujoco.MjsFlex:
    """Return a rope that lies straight along the way at first and does not stretch.

    thrown: speeds along and up (m/s). links: their number, each longer than the rope is thick. sliding:
    friction, no unit. drag: viscosity of the air (Pa s).
    """
    count, spacing = (links + 1, 1, 1), (length / links,) * 3
    shape = {"dim": 1, "spacing": spacing, "radius": radius, "mass": mass}
    flex = _flex(course, name, middle, colour, thrown, drag, count=count, **shape)
    flex.friction = [sliding, 0.005, 0.0001]
    return flex


def hammock(
    course: Course,
    name: str,
    middle: Vec3,
    size: tuple[float, float],
    cells: tuple[int, int],
    colour: str,
    *,
    sag: float,
    tied: Collection[int],
    thick: float = 0.006,
    mass: float = 0.12,
    sliding: float = 0.6,
    drag: float = 0.1,
) -> mujoco.MjsFlex:
    """Return a cloth that sags between its ends; its corners are where it is tied.

    middle: between its four corners. size, cells: along and across, in metres and in pieces. sag: how far (m) its
    middle hangs below. tied: at which ends: -1 is the near one along the way, 1 the far one. thick: half of its
    thickness (m). sliding, drag: as of a rope.
    """
    import mujoco

    count, spacing = (cells[0] + 1, cells[1] + 1, 1), (size[0] / cells[0], size[1] / cells[1], 3 * thick)
    flex = _flex(course, name, middle, colour, None, drag, dim=2, count=count, spacing=spacing, radius=thick, mass=mass)
    flex.friction, flex.selfcollide = [sliding, 0.005, 0.0001], mujoco.mjtFlexSelf.mjFLEXSELF_NONE
    for body in _vertices(course, name):
        along, across = (2 * (float(body.pos[i]) - middle[i] * (course.direction, 1)[i]) / size[i] for i in (0, 1))
        body.pos[2] -= sag * (1 - along**2) * (1 - 0.4 * across**2)
        is_corner = abs(along) > 1 - 1e-6 and abs(across) > 1 - 1e-6
        if is_corner and round(along) * course.direction in tied:
            knot = course.spec.add_equality(type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY)
            knot.name1, knot.name2 = body.name, "world"
    return flex


def soft_ball(
    course: Course,
    name: str,
    middle: Vec3,
    radius: float,
    colour: str,
    *,
    thrown: tuple[float, float],
    young: float,
    mass: float,
    sliding: float = 0.3,
    pieces: int = 6,
) -> mujoco.MjsFlex:
    """Return a soft ball. young: stiffness (Pa). pieces: cells of a diameter."""
    _settle(pieces)
    skin = 0.004
    spacing = (2 * (radius - skin) / pieces,) * 3
    flex = _flex(
        course,
        name,
        middle,
        colour,
        thrown,
        0.0,
        type="ellipsoid",
        dim=3,
        dof="quadratic",
        count=(pieces + 1,) * 3,
        spacing=spacing,
        radius=skin,
        mass=mass,
    )
    flex.young, flex.poisson, flex.damping = young, 0.3, 0.01
    flex.friction = [sliding, 0.005, 0.0001]
    return flex


@cache
def _settle(pieces: int) -> None:
    """Make a fixed ball before a process's first: it sets later balls' last bits.

    MuJoCo 4.0 takes masses and stiffness from the first one (docs/engineering-notes.md, "Physics").
    """
    import mujoco

    ball: dict[str, Any] = {"type": "ellipsoid", "dim": 3, "dof": "quadratic", "count": [pieces + 1] * 3}
    mujoco.MjSpec().worldbody.make_flex("ball", spacing=[0.02] * 3, radius=0.004, mass=0.4, inertiabox=0.01, **ball)


def _flex(
    course: Course,
    name: str,
    middle: Vec3,
    colour: str,
    thrown: tuple[float, float] | None,
    drag: float,
    *,
    count: Sequence[int],
    **shape: Any,
) -> mujoco.MjsFlex:
    import mujoco

    course.spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    course.spec.option.viscosity = drag
    ground = course.spec.worldbody
    at = [course.direction * middle[0], middle[1], middle[2]]
    shape = {"type": "grid", "equality": int(shape["dim"] < 3), **shape}
    flex = ground.make_flex(name, count=list(count), pos=at, inertiabox=0.01, **shape)
    flex.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_AUTO
    flex.condim, flex.priority, flex.rgba = 3, 1, rgba(colour)
    if thrown is not None:
        course.throw(name, *thrown)
    return flex


def _vertices(course: Course, name: str) -> list[mujoco.MjsBody]:
    """Return the bodies that carry a rope or a cloth, one a vertex."""
    return [body for body in course.spec.worldbody.bodies if body.name.rpartition("_")[0] == name]
