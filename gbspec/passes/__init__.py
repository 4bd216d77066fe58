"""Passes over a Model: substituting the truth, overriding values, laws and claims, contracts, identifiability.

The names are imported on first use, since `gbspec check` of a model needs only some of the passes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
