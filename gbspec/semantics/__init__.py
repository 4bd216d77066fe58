"""Checks on the syntax tree: scope, balances, calls, numbers, units; before sympy simplifies the expressions."""

from gbspec.semantics.check import check
from gbspec.semantics.checked import Checked

__all__ = ["Checked", "check"]
