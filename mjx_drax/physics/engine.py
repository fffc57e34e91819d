"""The one place that imports MuJoCo, so that a broken MUJOCO_GL gives one clear sentence.

If the libraries of the platform that MUJOCO_GL names are missing, `import mujoco` itself fails,
deep inside of PyOpenGL.
"""

from __future__ import annotations

import os

from mjx_drax.base.errors import DraxError

APT_EGL = "apt-get install -y --no-install-recommends libegl1 libopengl0 libgl1-mesa-dri"


class NoGraphics(DraxError, ImportError):
    """MuJoCo cannot be imported, because the libraries that MUJOCO_GL asks for are missing."""


try:
    import mujoco as mujoco
    from mujoco.rollout import Rollout as Rollout
except (AttributeError, ImportError) as error:
    _backend = os.environ.get("MUJOCO_GL")
    if not _backend or getattr(error, "name", None) == "mujoco":
        raise
    raise NoGraphics(
        f"MUJOCO_GL={_backend} is set, but its libraries cannot be loaded ({error}): "
        f"unset MUJOCO_GL, or run `{APT_EGL}` (for osmesa: libosmesa6)"
    ) from error
