"""C of right-hand side, Jacobian, observations and one step, made by casadi."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
