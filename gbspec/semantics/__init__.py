"""Checks on the syntax tree: scope, balances, calls, numbers, units; before sympy simplifies the expressions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
