"""What each statement says of itself, so that the rest of the syntax and the editor need to know nothing about it.

A new statement is a module here with a subclass of one of these, an entry in `gbspec.syntax.ast`, and a rule
`WORD_statement` in the grammar. Where another layer treats statements differently it matches on their classes, and mypy
names every such place that does not say what to do with the new one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Distribution, Expression, Index, Interval, Name, Node
from gbspec.syntax.rules import CONSTANT, Rule
from gbspec.syntax.transformer import Children, ClauseRules

Key = tuple[str, str]
"""What a statement replaces in an extended file, and is replaced by: the kind, and the name that it is about."""

Symbol = Literal["Module", "EnumMember", "Constant", "Variable", "Function", "Event", "Field", "Operator"]
"""The kinds of symbols of the language server protocol."""


@dataclass(frozen=True)
class Entry:
    """The line of a statement in the tables of the language.

    `word` is the keyword, or where `spelled` is False what the statement is called; its grammar rule is
    `WORD_statement`. `meaning` is a line for hover and completion. `title` is what several are called in an outline
    (None: not listed), `symbol` the editor's kind of symbol. `kind` and `role` tell what the names are that it
    declares, `about` which kinds of names may follow the keyword. `after` moves a clause in the canonical order: right
    behind that one.
    """

    word: str
    meaning: str
    example: str
    title: str | None
    symbol: Symbol = "Variable"
    kind: Kind | None = None
    role: str = ""
    about: frozenset[Kind] = frozenset()
    spelled: bool = True
    after: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Place:
    """One expression of a statement: the name that it is the value of (None: a root), its rule, what shadows in it."""

    expression: Expression
    rule: Rule
    owner: str | None = None
    formals: frozenset[str] = frozenset()
    nn: bool = False
    process: str | None = None
    """The process of which it is a side."""
    counts: bool = True
    """Whether naming something here uses it (a truth uses no learnable)."""


class StatementNode(Node, ABC):
    """A statement: what it is called and how it is read, what it declares and replaces, and its expressions."""

    entry: ClassVar[Entry]

    @classmethod
    @abstractmethod
    def read(cls, rules: ClauseRules, children: Children) -> Self:
        """The statement from what its grammar rule matched; mistakes are reported to `rules`."""

    @abstractmethod
    def declares(self) -> tuple[Name, ...]:
        """The names that it declares, the time's and a channel's own among them."""

    @abstractmethod
    def replaces(self) -> tuple[Key, ...]:
        """What it replaces in an extended file."""

    @abstractmethod
    def places(self) -> Iterator[Place]:
        """All its expressions; the index of a target is none."""


class Declaration(StatementNode):
    """A statement that declares names in the namespace of expressions, and replaces what declared them before."""

    def replaces(self) -> tuple[Key, ...]:
        """One for each name."""
        return tuple(("name", name.text) for name in self.declares())


@dataclass(frozen=True)
class Named(Declaration):
    """A declaration of the name after the keyword."""

    name: Name

    def declares(self) -> tuple[Name, ...]:
        """The one name."""
        return (self.name,)


@dataclass(frozen=True)
class About(StatementNode):
    """A statement about a name, or an element of an array, that another statement declares."""

    target: Name | Index

    def declares(self) -> tuple[Name, ...]:
        """Nothing."""
        return ()

    def replaces(self) -> tuple[Key, ...]:
        """The kind of statement and its target."""
        return ((self.entry.word, target_text(self.target)),)


class Formula(StatementNode):
    """A statement that has no numbers besides its expressions, and reads no column of the data."""


class Remark(StatementNode):
    """A statement without expressions, units and columns."""

    def declares(self) -> tuple[Name, ...]:
        """Nothing in the namespace of expressions."""
        return ()

    def places(self) -> Iterator[Place]:
        """None."""
        return iter(())


def target_name(target: Name | Index) -> Name:
    """The name that a statement is about; of an element, its array."""
    return target.array if isinstance(target, Index) else target


def target_text(target: Name | Index) -> str:
    """The target as a key: `X`, or `c[3]` without blanks."""
    return target.text if isinstance(target, Name) else "".join(target.span.text.split())


def fixed(*expressions: Expression | None) -> Iterator[Place]:
    """Places of numbers and constants."""
    for expression in expressions:
        if expression is not None:
            yield Place(expression, CONSTANT)


def ends(interval: Interval | None) -> Iterator[Place]:
    """The places of a range."""
    if interval is not None:
        yield from fixed(interval.low, interval.high)


def parameters(distribution: Distribution | None) -> Iterator[Place]:
    """The places of a prior or a noise."""
    if distribution is not None:
        yield from fixed(*distribution.arguments)
