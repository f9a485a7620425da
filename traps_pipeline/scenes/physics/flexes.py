"""Query the soft bodies (MuJoCo's flexes) of a compiled model.

A soft body is named in the roles of a scene as any other body is. It has no pose: it is where its vertices are, which
follow from the poses of the bodies that carry it, and it is drawn as a whole.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco


def flexes(model: mujoco.MjModel) -> dict[str, int]:
    """Return the id of each soft body, by name, in the order of the model."""
    import mujoco

    return {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, i): i for i in range(model.nflex)}


def carriers(model: mujoco.MjModel, flex: int) -> np.ndarray:
    """Return ids of the bodies that carry a soft body: a vertex or a cage node each."""
    if model.flex_interp[flex]:
        first, count, bodies = model.flex_nodeadr[flex], model.flex_nodenum[flex], model.flex_nodebodyid
    else:
        first, count, bodies = model.flex_vertadr[flex], model.flex_vertnum[flex], model.flex_vertbodyid
    return bodies[int(first) : int(first) + int(count)]


def soft_body_mask(model: mujoco.MjModel) -> np.ndarray:
    """Return whether each body does nothing but carry a soft body, (nbody,) bool."""
    mask = np.zeros(model.nbody, bool)
    for flex in range(model.nflex):
        mask[carriers(model, flex)] = True
    return mask


def flex_vertices(model: mujoco.MjModel, data: mujoco.MjData, flex: int) -> np.ndarray:
    """Return the vertices of a soft body (m), (V, 3), at the computed poses."""
    import mujoco

    mujoco.mj_flex(model, data)
    first = int(model.flex_vertadr[flex])
    return data.flexvert_xpos[first : first + int(model.flex_vertnum[flex])]


def elements(model: mujoco.MjModel, flex: int) -> np.ndarray:
    """Return the vertices of a soft body's elements, (E, 2 to 4)."""
    corners, first = int(model.flex_dim[flex]) + 1, int(model.flex_elemdataadr[flex])
    return model.flex_elem[first : first + corners * int(model.flex_elemnum[flex])].reshape(-1, corners)
