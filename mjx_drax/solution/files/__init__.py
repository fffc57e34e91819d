"""The files that hold a solution: written, and loaded again."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
