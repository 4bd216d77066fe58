"""A model as a page of typeset equations and tables."""

from gbspec.backends.latex.document import document
from gbspec.backends.latex.equations import balances, expression, name, observations, starts

__all__ = ["balances", "document", "expression", "name", "observations", "starts"]
