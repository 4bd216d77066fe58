"""Expressions as text: one printer base, straight lists of statements, safe names."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
