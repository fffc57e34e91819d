"""Speed and nothing else: arrays in, arrays out; each kernel is there in plain JAX too."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
