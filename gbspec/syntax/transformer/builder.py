"""The rules of the whole grammar: clauses, expressions and statements."""

from __future__ import annotations

from functools import partial

from lark import Token, Transformer

from gbspec.syntax import ast
from gbspec.syntax.transformer.clauses import ClauseRules


class Builder(Transformer[Token, ast.Node], ClauseRules):
    """Builds the nodes of one statement at a time."""

    def __init__(self) -> None:
        Transformer.__init__(self)
        ClauseRules.__init__(self, frozenset(s.entry.word for s in ast.STATEMENTS if s.entry.reserved))
        for statement in ast.STATEMENTS:
            setattr(self, f"{statement.entry.word}_statement", partial(statement.read, self))
