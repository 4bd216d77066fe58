"""Populations: the marginal likelihood of constants that are distributed between trajectories, and its maximum."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
