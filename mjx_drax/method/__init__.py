"""The method of the paper, equations only.

Read schedules, model, bounds, metrics, riccati, gauss_newton, descent, langevin.
"""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
