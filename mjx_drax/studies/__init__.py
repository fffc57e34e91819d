"""Benchmarks, comparisons with other methods, and the figures of the paper."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
