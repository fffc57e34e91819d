"""From a MuJoCo model to dynamics. The only room that imports mujoco and mjx, but for drawing."""

import pkgutil

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submodules=[module.name for module in pkgutil.iter_modules(__path__)]
)
