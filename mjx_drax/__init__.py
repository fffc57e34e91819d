"""Trajectories for MuJoCo models by equality-constrained Langevin diffusion.

>>> problem = mjx_drax.from_mjcf("robot.xml", running_cost=..., terminal_cost=..., horizon=2.0)
>>> solution = mjx_drax.solve(problem, chains=256, seed=0)
>>> mjx_drax.render(solution, "out.mp4")

Names are loaded when they are first used, so that importing the package costs nothing.
"""

import os
import sys
from importlib import import_module
from importlib.util import find_spec

import lazy_loader

from mjx_drax import _checkout as _checkout
from mjx_drax.base.xla import avoid_wrong_sums

# XLA logs alarms about slow compiles and other machines' programs, as errors; what fails raises an
# exception all the same. JAX itself says 1 where the user says nothing.
if "TF_CPP_MIN_LOG_LEVEL" not in os.environ or (
    "jax" in sys.modules and os.environ["TF_CPP_MIN_LOG_LEVEL"] == "1"
):
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
avoid_wrong_sums()

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """A public name, or a room such as `mjx_drax.view`."""
    known = name in __all__ or not name.isidentifier()
    room = None if known else find_spec(f"{__name__}.{name}")
    if room and room.submodule_search_locations:
        return import_module(room.name)
    return _public(name)
