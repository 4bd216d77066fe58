"""Backends: from one Model to other languages and to functions, each a folder.

A folder whose `backend.py` has a `BACKEND` is a form of `gbspec compile --emit`; `registry` finds it there. `printing`
and `protocol` (what a generated module offers) are what backends share; they do not import each other.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
