"""One place that imports MJX, which would announce that warp is missing; nothing here needs it."""

from __future__ import annotations

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx as mjx
    from mujoco.mjx._src.solver import (
        Context as Context,  # not public; the law of constraint forces
    )
