"""Speed and nothing else: arrays in, arrays out, each kernel with a plain twin."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
