"""Figures: each module builds the description of one kind of figure, from a run or from a result."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
