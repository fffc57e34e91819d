"""What is solved: trajectories, bounds, costs, dynamics, and how they are built and checked."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
