"""Checked syntax tree to Model: the one place where names become symbols and text becomes mathematics."""

from gbspec.lower.command import lower_expression
from gbspec.lower.statements import lower

__all__ = ["lower", "lower_expression"]
