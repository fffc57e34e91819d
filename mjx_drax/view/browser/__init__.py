"""Solutions in the browser: a page to keep, and a scene that a running program shows."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
