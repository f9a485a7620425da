"""Test whether this machine can draw a frame and encode a clip."""

import os
import re
import tempfile
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.workers import run_in_order

_OPENGL = re.compile(r"MUJOCO_|PYOPENGL_|MESA_|GALLIUM_|LIBGL_|LP_NATIVE|EGL_|__E?GL|LD_LIBRARY_PATH$|LD_PRELOAD$")


def render_frame() -> str:
    """Draw a red ball; return the renderer's name. Raises TrapsError with the remedy."""
    import numpy as np

    try:
        from traps_pipeline.scenes.physics.kit import Physics, View, add_ball, new_spec
        from traps_pipeline.scenes.picture.camera import fit_camera
        from traps_pipeline.scenes.picture.render import Renderer, gl_version

        spec = new_spec(Physics())
        add_ball(spec, "ball", (0, 0, 0.1), 0.1, "red")
        model = spec.compile()
        with Renderer(model, fit_camera(View(), np.array([[-0.3, 0, 0], [0.3, 0, 0.4]]))) as renderer:
            frame = next(renderer.frames([model.qpos0]))
            version = gl_version()
    except Exception as error:
        raise TrapsError(_unusable(f"{error.__cause__ or error}")) from error
    red = int((frame[..., 0].astype(int) - frame[..., 1] > 60).sum())
    if red < 100:
        raise TrapsError(_unusable(f"a red ball was drawn with {red} red pixels"))
    return f"MUJOCO_GL={os.environ.get('MUJOCO_GL')}, {version}, one frame drawn ({red} red pixels of the ball)"


def opengl_variables() -> dict[str, str]:
    """Return the environment variables that select and configure the renderer."""
    variables = {name: value for name, value in sorted(os.environ.items()) if _OPENGL.match(name)}
    # OpenCV adds a folder of its own to the loader's when it is imported: nobody chose that.
    folders = [folder for folder in variables.pop("LD_LIBRARY_PATH", "").split(":") if folder and "/cv2/" not in folder]
    return variables | ({"LD_LIBRARY_PATH": ":".join(folders)} if folders else {})


def _unusable(reason: str) -> str:
    variables = ", ".join(f"{name}={value[:60]}" for name, value in opengl_variables().items())
    return (
        f"this machine cannot render clips with {variables} ({' '.join(reason.split())[:300]}): unset these variables "
        "and, on Debian, apt-get install libosmesa6"
    )


def encode_clip() -> str:
    """Check that video can be written and read: encode three frames, decode them. Raises TrapsError."""
    import numpy as np

    from traps_pipeline.video.encode import decode, encode

    frames = [np.full((360, 480, 3), shade, np.uint8) for shade in (40, 80, 120)]
    try:
        with tempfile.TemporaryDirectory() as folder:
            encode(frames, Path(folder) / "probe.mp4", fps=10)
            decoded, _ = decode(Path(folder) / "probe.mp4")
    except Exception as error:
        raise TrapsError(f"this machine cannot encode clips ({error}): reinstall the pinned av") from error
    if len(decoded) != len(frames):
        raise TrapsError(f"{len(decoded)} of {len(frames)} frames came back; reinstall the pinned av")
    return "H.264 written and read back"


def check_rendering() -> None:
    """Draw and encode in a process of its own. Raises TrapsError."""
    try:
        ((_, problem),) = run_in_order(_problem, [None], workers=1)
    except BrokenProcessPool:
        problem = _unusable("the process that drew ended at once")
    if problem:
        raise TrapsError(problem)


def _problem(_: None) -> str:
    try:
        render_frame()
        encode_clip()
    except TrapsError as error:
        return str(error)
    return ""
