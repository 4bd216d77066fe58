"""Structural identifiability: learnable constants and unknown functions that no data can separate."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
