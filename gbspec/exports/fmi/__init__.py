"""Functional mock-up units of FMI 2.0 and 3.0, around the C library of a model."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
