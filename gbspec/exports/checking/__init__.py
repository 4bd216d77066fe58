"""The comparison of an export with the generated module, at points within the ranges of the model."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
