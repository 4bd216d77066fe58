"""Imports of models of other formats: each becomes a description, from which a `.gb` file is written."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
