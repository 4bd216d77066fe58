"""`diffusion`: the intensity of the random disturbance of a state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Index, Name, Text
from gbspec.syntax.statements.base import About, Entry, Formula, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class DiffusionStatement(About, Formula):
    """`diffusion X = sigma`: dX = (balance) dt + sigma dW."""

    entry = Entry(
        word="diffusion",
        meaning="the random disturbance of a state (Ito): dX = (balance) dt + sigma dW, in units of X per root of time",
        example='diffusion X = sigma "weather"',
        title="disturbances",
        symbol="Event",
        about=frozenset({Kind.STATE}),
        reserved=False,
    )
    value: Expression
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `diffusion target` and its clauses."""
        found = reader.gather(children, "a diffusion")
        target: Name | Index = children[1]
        text = target.span.text
        message = f"`diffusion {text}` does not say how large the disturbance is"
        value = reader.required(children, found, "value", message, f"write `diffusion {text} = …`")
        return cls(reader.over(children), target, value, found.get("text"))

    def places(self) -> Iterator[Place]:
        """The intensity."""
        yield Place(self.value, rules.DISTURBANCE)
