"""Reads tables to trajectories and writes them: measurements, inputs and doses; and the cases that describe data."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
