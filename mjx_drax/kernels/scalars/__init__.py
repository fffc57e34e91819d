"""Functions of one knot as programs of scalars, which compile to a few fused loops."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
