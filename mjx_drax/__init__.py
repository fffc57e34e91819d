"""Trajectories for MuJoCo models by equality-constrained Langevin diffusion.

>>> problem = mjx_drax.from_mjcf("robot.xml", running_cost=..., terminal_cost=..., horizon=2.0)
>>> solution = mjx_drax.solve(problem, chains=256, seed=0)
>>> mjx_drax.render(solution, "out.mp4")

Names are loaded when they are first used, so that importing the package costs nothing.
"""

import lazy_loader

from mjx_drax import _checkout as _checkout

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
