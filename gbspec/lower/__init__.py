"""Checked syntax tree to Model: the one place where names become symbols and text becomes mathematics."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
