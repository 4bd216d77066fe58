"""The recipe of training: the stages, their order, and the data that they work with."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
