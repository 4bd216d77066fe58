"""The starting point of a fit: curves, slopes, gradient matching, search, initial states."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
