"""PEtab 1: a model with conditions, measurements, observables and parameters, as a description and a table."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
