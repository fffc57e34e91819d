"""One place that imports MJX, which would announce that warp is missing; nothing here needs it."""

from __future__ import annotations

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx as mjx

    # What follows is not public: what MJX can collide, and how; frames of contacts
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
    from mujoco.mjx._src.solver import (
        Context as Context,  # the law of constraint forces
    )
