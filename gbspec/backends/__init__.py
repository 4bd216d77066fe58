"""Backends, one folder each: they translate a Model to other languages and to functions.

A folder whose `backend.py` defines `BACKEND` is an output form of `gbspec compile --emit`; `registry` finds it.
`printing` holds what backends share; they do not import each other.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
