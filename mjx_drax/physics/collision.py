"""Contacts of MJX, with boxes on planes as MuJoCo's C engine has them.

MJX makes contacts at the corners of a box that are within 1 mm of the lowest one. The C engine
takes all corners of the lower half, so that a tilted box has more contacts there.
"""

from __future__ import annotations

import itertools
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics._mjx import COLLISIONS, make_frame, mjx
from mjx_drax.physics.engine import mujoco

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""The corners of a cube, (8, 3)."""

_PLANE_BOX = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)
_ONE_AT_A_TIME = threading.Lock()


def collision(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.collision`: `data` with all contacts."""
    with _ONE_AT_A_TIME:  # MJX has one table of functions for all threads; it is restored
        before = COLLISIONS[_PLANE_BOX]
        COLLISIONS[_PLANE_BOX] = plane_box
        try:
            return mjx.collision(model, data)
        finally:
            COLLISIONS[_PLANE_BOX] = before


def plane_box(model: mjx.Model, data: mjx.Data, _: Any, geom: Array) -> tuple[Array, Array, Array]:
    """Distances (4 n,), positions (4 n, 3) and frames (4 n, 3, 3) of contacts of pairs (n, 2)."""
    plane, box = geom.T
    normal = data.geom_xmat[plane][:, None, :, 2]
    cube = CORNERS.astype(normal.dtype)  # a copy: JAX knows an array by its identity
    from_centre = jnp.sum(
        data.geom_xmat[box][:, None] * (cube * model.geom_size[box][:, None])[:, :, None],
        axis=-1,
    )
    corners = data.geom_xpos[box][:, None] + from_centre
    height = jnp.sum((corners - data.geom_xpos[plane][:, None]) * normal, axis=-1)
    _, lowest = jax.lax.top_k(-height, 4)
    dist = jnp.take_along_axis(height, lowest, axis=1)
    pos = jnp.take_along_axis(corners, lowest[..., None], axis=1) - 0.5 * dist[..., None] * normal
    frame = jnp.repeat(jax.vmap(make_frame)(normal[:, 0]), 4, axis=0)
    return dist.reshape(-1), pos.reshape(-1, 3), frame


plane_box.ncon = 4  # type: ignore[attr-defined]  # contacts of a pair, which MJX reads
