"""Meaning: scope, balances, calls, numbers; the checks that come before sympy can rewrite the evidence."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
