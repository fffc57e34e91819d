"""From a MuJoCo model to dynamics. The only room that imports mujoco and mjx, but for drawing."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
