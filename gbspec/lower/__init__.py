"""From the checked syntax tree to the Model: names become symbols, expressions become sympy expressions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
