"""Expressions as text: the base of all printers, lists of assignments, safe names."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
