"""`function`: a known function."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Name, Text
from gbspec.syntax.statements.base import Entry, Formula, Named, Place
from gbspec.syntax.transformer import Children, ClauseRules, Names, tokens


@dataclass(frozen=True)
class FunctionStatement(Named, Formula):
    """`function monod(s, K) = s/(K + s)`."""

    entry = Entry(
        word="function",
        meaning="a known function",
        example='function monod(s, K) = s/(K + s) "saturation"',
        title="functions",
        symbol="Function",
        kind=Kind.FUNCTION,
        role="known function",
    )
    parameters: tuple[Name, ...]
    value: Expression
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `function NAME(names)` and its clauses."""
        found = reader.gather(children, "a function")
        name = reader.declared(children[1])
        formals = next((child.items for child in children if isinstance(child, Names)), ())
        head = reader.place(children[1], tokens(children, "RPAR")[0]).text
        message = f"the function `{name.text}` has no formula"
        help = f"write `function {head} = …`; a function to be learned is `unknown {head}`"
        value = reader.required(children, found, "value", message, help)
        return cls(reader.over(children), name, formals, value, found.get("text"))

    def places(self) -> Iterator[Place]:
        """The value."""
        yield Place(self.value, rules.ANY, self.name.text, frozenset(p.text for p in self.parameters))

    def formals(self) -> tuple[Name, ...]:
        """The parameters."""
        return self.parameters
