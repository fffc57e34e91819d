"""What came of a solve: replays, the certificate, and the files that hold them."""

from mjx_drax.base.rooms import by_name

__getattr__, __dir__, __all__ = by_name(__name__, __path__)
