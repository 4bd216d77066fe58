"""C kernel of the whole unroll: solution and gradient of a packed batch in one call, if there is a C compiler."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
