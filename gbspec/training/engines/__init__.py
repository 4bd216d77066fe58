"""Engines: solutions of a problem and their derivatives at a trainable vector, by the torch graph or the native
kernel."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
