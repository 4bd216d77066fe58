"""The rules of the whole grammar: those of clauses and expressions, and each statement's own."""

from __future__ import annotations

from functools import partial

from lark import Token, Transformer

from gbspec.syntax import ast
from gbspec.syntax.transformer.clauses import ClauseRules


class Builder(Transformer[Token, ast.Node], ClauseRules):
    """Builds the nodes of one statement after the other."""

    def __init__(self) -> None:
        Transformer.__init__(self)
        ClauseRules.__init__(self, frozenset(ast.WORDS))
        for statement in ast.STATEMENTS:
            setattr(self, f"{statement.entry.word}_statement", partial(statement.read, self))
