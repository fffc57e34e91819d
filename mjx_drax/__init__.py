"""Trajectories for MuJoCo models by equality-constrained Langevin diffusion.

>>> problem = mjx_drax.from_mjcf("robot.xml", running_cost=..., terminal_cost=..., horizon=2.0)
>>> solution = mjx_drax.solve(problem, chains=256, seed=0)
>>> mjx_drax.render(solution, "out.mp4")

Names are loaded when they are first used, so that importing the package costs nothing.
"""

import os
import sys

import lazy_loader

from mjx_drax import _checkout as _checkout

# XLA logs alarms about slow compiles and other machines' programs, as errors; what fails raises an
# exception all the same. JAX itself says 1 where the user says nothing.
if "TF_CPP_MIN_LOG_LEVEL" not in os.environ or (
    "jax" in sys.modules and os.environ["TF_CPP_MIN_LOG_LEVEL"] == "1"
):
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
