"""What a model says: simulation, validation, steady states, eigenvalues, bifurcations and limit cycles."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
