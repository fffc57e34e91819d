"""The one place that imports MJX, and that names what is not public in it.

MJX announces that warp is missing when it is imported; nothing here needs it, so that is not shown.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

from mjx_drax.physics.engine import mujoco as mujoco  # first: it says what is wrong if this fails

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx as mjx

    # Not public: what MJX can collide, and how; hulls of meshes; frames of contacts; rows of
    # constraints
    from mujoco.mjx._src import collision_driver as collision_driver
    from mujoco.mjx._src import constraint as constraint
    from mujoco.mjx._src import mesh as meshes  # noqa: F401
    from mujoco.mjx._src.collision_convex import _manifold_points as four_of  # noqa: F401
    from mujoco.mjx._src.collision_driver import (
        _COLLISION_FUNC as COLLISIONS,  # noqa: F401
    )
    from mujoco.mjx._src.collision_driver import (
        geom_pairs as geom_pairs,
    )
    from mujoco.mjx._src.collision_driver import (
        has_collision_fn as has_collision_fn,
    )
    from mujoco.mjx._src.math import make_frame as make_frame
    from mujoco.mjx._src.types import ConvexMesh as ConvexMesh


def internal(data: mjx.Data) -> Any:
    """The arrays of `mjx.Data` that are not public: M, cinert, efc_J, contact, ..."""
    return data._impl


def with_internal(data: mjx.Data, **arrays: Any) -> mjx.Data:
    """`data` with other arrays for some of those that are not public."""
    return data.replace(_impl=data._impl.replace(**arrays))
