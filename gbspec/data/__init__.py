"""Tables to trajectories and back: the measurements, their inputs and doses, and the cases that describe them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
