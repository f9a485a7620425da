"""Render a trajectory's frames with MuJoCo at twice the size, averaged 2x2.

One off-screen GL context lives as long as the process; each `Renderer` owns one `MjrContext` for its model.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from traps_pipeline.scenes.physics.flexes import flexes
from traps_pipeline.scenes.physics.kit import COMING_GROUP, FLOOR_GROUP, OCCLUDER_GROUP, REMOVED_GROUP
from traps_pipeline.scenes.picture.camera import HEIGHT, WIDTH, Camera
from traps_pipeline.scenes.picture.coming_board import Offset

if TYPE_CHECKING:
    import mujoco

SUPERSAMPLE = 2
_gl_context: object | None = None
_renderer_open = False  # contexts of two models in one GL context would draw into each other's buffers


class RenderingUnavailable(RuntimeError):
    """Raised where no off-screen GL is usable; the message says what to install."""


def _make_current(width: int, height: int) -> None:
    global _gl_context
    if _gl_context is None:
        try:
            import mujoco

            _gl_context = mujoco.GLContext(width, height)  # type: ignore[attr-defined]
            atexit.register(_gl_context.free)  # type: ignore[attr-defined]
        except (ImportError, AttributeError, OSError, RuntimeError) as error:
            raise RenderingUnavailable(
                f"no off-screen OpenGL (MUJOCO_GL={os.environ.get('MUJOCO_GL')}): {error}; "
                "on Debian: apt-get install libosmesa6"
            ) from error
    _gl_context.make_current()  # type: ignore[attr-defined]


def gl_version() -> str:
    """Return OpenGL's version, on which single pixels depend; needs an open Renderer."""
    from OpenGL.GL import GL_VERSION

    return _gl_text(GL_VERSION)


def renderer_version() -> str:
    """Return OpenGL's version and renderer, which decide pixels. Raises RenderingUnavailable."""
    _make_current(WIDTH * SUPERSAMPLE, HEIGHT * SUPERSAMPLE)
    from OpenGL.GL import GL_RENDERER

    return f"{gl_version()}, {_gl_text(GL_RENDERER)}"


def _gl_text(name: int) -> str:
    from OpenGL.GL import glGetString

    text = glGetString(name)
    return text.decode(errors="replace") if isinstance(text, bytes) else "an unknown OpenGL"


def _make_floors_finite(model: mujoco.MjModel, camera: Camera) -> None:
    """Give each plane a finite size that reaches beyond what the camera sees.

    An infinite one is drawn as a grid of 200 x 200 cells in each pass, a third of a frame's time in some scenes; a
    finite one as 2 x 2. Collisions know no difference. Its texture lies where that of the infinite one does: by its
    centre where the half size is an odd number of repeats (`settexture` and `makePlane` of MuJoCo).
    """
    import mujoco

    reach = 1.05 * model.vis.map.zfar * camera.extent
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        material = model.geom_matid[plane]
        repeats_a_metre = model.mat_texrepeat[material] if material >= 0 else np.ones(2)
        wanted_m = reach + float(np.abs(camera.position() - model.geom_pos[plane]).max())
        halves = (np.ceil(wanted_m * repeats_a_metre / 2) * 2 + 1) / repeats_a_metre
        model.geom_size[plane] = [*halves, halves.max()]  # at last the spacing of the grid


class Renderer:
    """A context manager that draws a model from a camera: uint8 RGB, (360, width, 3).

    Frames are (720, 960, 3) of a model whose look is as fine as that. supersample: factor by which the drawing is
    larger; 1 takes a quarter of the time, where edges need not be smooth.
    """

    def __init__(self, model: mujoco.MjModel, camera: Camera, *, supersample: int = SUPERSAMPLE) -> None:
        global _renderer_open
        if _renderer_open:
            raise RuntimeError("a Renderer is open in this process; close it before the next one")
        self._fine = max(1, model.vis.global_.offheight // (HEIGHT * SUPERSAMPLE))  # where a look says so
        self._scale = supersample * self._fine
        self._size = (camera.width * self._fine, HEIGHT * self._fine)
        self._width, self._height = (side * supersample for side in self._size)
        _make_current(self._width, self._height)
        import mujoco

        model.vis.global_.offwidth, model.vis.global_.offheight = self._width, self._height
        model.vis.global_.fovy = camera.fovy_deg
        model.stat.extent = camera.extent
        model.stat.center[:] = camera.centre
        _make_floors_finite(model, camera)
        self._pixels = np.empty((self._height, self._width, 4), np.uint8)
        self._drawn: tuple[object, ...] | None = None  # what the picture in `_pixels` is of
        self._model, self._data, self._soft = model, mujoco.MjData(model), flexes(model)
        self._comes, self._boards = False, np.flatnonzero(model.geom_group == COMING_GROUP)
        self._board_places = model.geom_pos[self._boards].copy()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.lookat[:] = camera.lookat
        self._camera.distance = camera.distance
        self._camera.azimuth, self._camera.elevation = camera.azimuth_deg, camera.elevation_deg
        _renderer_open = True
        self._draw(model.qpos0, occluder=True, without=())
        self._drawn = None  # a first picture differs from later ones, in single pixels

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        global _renderer_open
        _renderer_open = False
        self._put_board(None)
        self._context.free()

    def frames(
        self,
        qpos: Sequence[np.ndarray] | np.ndarray,
        *,
        occluder: bool = False,
        without: Sequence[str] = (),
        board: Offset | None = None,
    ) -> Iterator[np.ndarray]:
        """Yield RGB frames of a trajectory (F, nq).

        without: geoms that are taken away (an ablation). board: offset (m) of a board that comes.
        """
        import cv2

        for row in qpos:
            self._put_board(board)
            raw = self._draw(row, occluder=occluder, without=without)
            frame = cv2.resize(raw, self._size, interpolation=cv2.INTER_AREA)
            yield cv2.flip(cv2.cvtColor(frame, cv2.COLOR_RGBA2RGB), 0)

    def visible_pixels(
        self, qpos: Sequence[np.ndarray] | np.ndarray, geoms: Sequence[str], *, occluder: bool = False
    ) -> np.ndarray:
        """Return pixels of each geom or soft body at 480x360, quarters included, (F, G)."""
        import mujoco

        kinds = (int(mujoco.mjtObj.mjOBJ_GEOM), int(mujoco.mjtObj.mjOBJ_FLEX))
        keys = [(kinds[self._is_soft(name)], self._number(name)) for name in geoms]
        counts = np.zeros((len(qpos), len(keys)))
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        try:
            self._put_board(None)
            for i, row in enumerate(qpos):
                rgba = self._draw(row, occluder=occluder, without=())
                pixels = np.bincount((rgba.view("<u4") & 0xFFFFFF).ravel())  # a segment's id is its colour
                shapes = self._scene.geoms[: self._scene.ngeom]
                shape_of = {g.segid + 1: (g.objtype, g.objid) for g in shapes if g.objtype in kinds}
                pixels_of = {key: pixels[id_] for id_, key in shape_of.items() if id_ < len(pixels)}
                counts[i] = [pixels_of.get(key, 0) / self._scale**2 for key in keys]
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        return counts

    def _put_board(self, offset: Offset | None) -> None:
        """Move the coming board to an offset; None: there is none."""
        self._comes = offset is not None
        if self._boards.size:
            self._model.geom_pos[self._boards] = self._board_places + np.array(offset or (0.0, 0.0, 0.0))

    def _draw(self, qpos: np.ndarray, *, occluder: bool, without: Sequence[str]) -> np.ndarray:
        """Return the picture of a pose, RGBA, bottom row first, until the next draw.

        What is shown is not drawn again while all of it stays in place: things come to rest, in some families for half
        of a clip, or what moves is taken away. (Only the coming board changes the model.)
        """
        import mujoco

        self._data.qpos[:] = qpos
        self._place()
        state = (*self._places(occluder, without), occluder, self._comes, tuple(without), self._scene.flags.tobytes())
        if state == self._drawn:
            return self._pixels
        self._drawn = None
        option = mujoco.MjvOption()
        option.geomgroup[:] = 1
        option.geomgroup[OCCLUDER_GROUP], option.geomgroup[COMING_GROUP] = int(occluder), int(self._comes)
        option.geomgroup[FLOOR_GROUP] = option.geomgroup[REMOVED_GROUP] = option.flexgroup[REMOVED_GROUP] = 0
        all_categories, no_perturbation = mujoco.mjtCatBit.mjCAT_ALL, mujoco.MjvPerturb()
        groups, soft_groups = self._model.geom_group.copy(), self._model.flex_group.copy()
        self._model.geom_group[self._model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = FLOOR_GROUP
        for name in without:
            target = self._model.flex_group if self._is_soft(name) else self._model.geom_group
            target[self._number(name)] = REMOVED_GROUP
        try:
            mujoco.mjv_updateScene(
                self._model, self._data, option, no_perturbation, self._camera, all_categories, self._scene
            )
            # The floor last: what stands before it is not painted over. The same picture, up to a fifth sooner.
            for target in (option.geomgroup, option.flexgroup, option.sitegroup, option.tendongroup, option.skingroup):
                target[:] = 0
            option.geomgroup[FLOOR_GROUP] = 1
            mujoco.mjv_addGeoms(self._model, self._data, option, no_perturbation, all_categories, self._scene)
            self._add_haze()
        finally:
            self._model.geom_group[:], self._model.flex_group[:] = groups, soft_groups
        viewport = mujoco.MjrRect(0, 0, self._width, self._height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        self._read()
        self._drawn = state
        return self._pixels

    def _add_haze(self) -> None:
        """Let the far end of the floor fade, by a plane without area.

        MuJoCo draws that haze where it finds an infinite plane.
        """
        import mujoco

        for plane in np.flatnonzero(self._model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)[:1]:
            place, turn = self._data.geom_xpos[plane], self._data.geom_xmat[plane]
            haze_geom = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(
                haze_geom, mujoco.mjtGeom.mjGEOM_PLANE, np.zeros(3), place, turn, np.ones(4, np.float32)
            )
            self._scene.ngeom += 1

    def _is_soft(self, name: str) -> bool:
        return name in self._soft

    def _number(self, name: str) -> int:
        """Return the id of a geom or a soft body."""
        return self._soft[name] if self._is_soft(name) else self._model.geom(name).id

    def _places(self, occluder: bool, without: Sequence[str]) -> tuple[bytes, ...]:
        """Return poses of all that is shown, and the lights, to the last bit.

        In a model with other things than geoms the whole pose stands for them.
        """
        model, data = self._model, self._data
        removed_ids = [self._number(name) for name in without if not self._is_soft(name)]
        groups = model.geom_group
        is_shown = (groups != REMOVED_GROUP) & ((groups != OCCLUDER_GROUP) | occluder)
        is_shown &= (groups != COMING_GROUP) | self._comes
        is_shown[removed_ids] = False
        places = (data.geom_xpos[is_shown], data.geom_xmat[is_shown], data.light_xpos, data.light_xdir)
        pose = data.qpos if model.nflex or model.nsite or model.ntendon or model.nskin else np.empty(0)
        return (*(values.tobytes() for values in places), pose.tobytes())

    def _place(self) -> None:
        """Compute all poses that drawing needs at the present qpos, without dynamics."""
        import mujoco

        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex, mujoco.mj_tendon):
            step(self._model, self._data)

    def _read(self) -> None:
        """Fetch the off-screen buffer, 30 times faster than mjr_readPixels."""
        from OpenGL import GL

        GL.glReadBuffer(GL.GL_COLOR_ATTACHMENT0)
        GL.glReadPixels(0, 0, self._width, self._height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, self._pixels)
