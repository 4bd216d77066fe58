"""C for the whole unroll: solution and gradient of a packed batch in one call, compiled where there is a compiler."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
