"""Passes over a Model: the truth put in, values overridden, laws and claims, contracts, what data can tell.

What stands here is loaded when it is asked for, since `gbspec check` of a model needs only some of the passes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
