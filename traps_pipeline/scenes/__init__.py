"""Turn scene parameters into encoded clips: build, simulate, render and check.

MuJoCo reads MUJOCO_GL when it is first imported, so a GL that needs no display is chosen here, before any module of
this package can import it; a caller's own choice stands.
"""

import os

os.environ.setdefault("MUJOCO_GL", "osmesa")
if os.environ["MUJOCO_GL"] == "osmesa":
    os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa")
os.environ.setdefault("LP_NUM_THREADS", "0")  # one process a core beats many threads in one
