"""From the checked syntax tree to the Model: names become symbols, expressions become sympy expressions."""

from gbspec.lower.command import lower_expression
from gbspec.lower.statements import lower

__all__ = ["lower", "lower_expression"]
