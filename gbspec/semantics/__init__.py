"""Meaning: scope, balances, calls, numbers; the checks that come before sympy can rewrite the evidence."""

from gbspec.semantics.check import check
from gbspec.semantics.checked import Checked

__all__ = ["Checked", "check"]
