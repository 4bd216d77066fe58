"""Engines: what a fit needs of a problem at a vector, by the torch graph or by the native kernel."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
