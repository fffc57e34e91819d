"""From a chain's knots to a local optimum: Newton steps until a residual is small."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
