"""What every room uses: errors, pytrees, files. No numerics."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
