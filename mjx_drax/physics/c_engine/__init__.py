"""MuJoCo's C engine: states in float64, and steps of one or of many."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
