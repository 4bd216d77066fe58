"""The interface of statements, so that the rest of the syntax and the editor need no code per statement.

A new statement is a module here with a subclass of one of these classes, an entry in `gbspec.syntax.ast`, and a rule
`WORD_statement` in the grammar. Layers that treat statements differently match on their classes, and mypy
reports every such match that lacks the new one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Self

from gbspec.diagnostics import Span
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Distribution, Expression, Index, Interval, Name, Node
from gbspec.syntax.rules import CONSTANT, Rule
from gbspec.syntax.transformer import Children, ClauseRules

Key = tuple[str, str]
"""The key by which a statement replaces one of an extended file: the kind, and the name that it is about."""

Symbol = Literal["Module", "EnumMember", "Constant", "Variable", "Function", "Event", "Field", "Operator"]
"""The kinds of symbols of the language server protocol."""


@dataclass(frozen=True)
class Entry:
    """The line of a statement in the tables of the language.

    `word` is the keyword, or if `spelled` is False the name of the statement; its grammar rule is `WORD_statement`.
    `meaning` is a line for hover and completion. `title` is the heading of a group of them in an outline (None: not
    listed), `symbol` the editor's kind of symbol. `kind` and `role` describe the names that it declares, `about` is the
    set of kinds of names that may follow the keyword. `after` moves a clause (the key) in the canonical order directly
    behind another (the value). `reserved`: no state may have the keyword as its name (statements of edition 1).
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
    reserved: bool = True
    after: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Place:
    """One expression of a statement: the name whose value it is (None: a root), its rule, and the names local to it."""

    expression: Expression
    rule: Rule
    owner: str | None = None
    formals: frozenset[str] = frozenset()
    nn: bool = False
    process: str | None = None
    """The process, if the expression is one of its sides."""
    counts: bool = True
    """Whether an occurrence of a name here counts as a use (not in a truth: it uses no learnable)."""


@dataclass(frozen=True)
class Mention:
    """A name in a remark: of a model, a unit, a code, or a name of the model; and whether the remark declares it."""

    name: Name
    space: Literal["model", "unit", "code", "name"]
    declares: bool = False


class StatementNode(Node, ABC):
    """A statement: its entry, how it is built, what it declares and replaces, and its expressions."""

    entry: ClassVar[Entry]

    @classmethod
    @abstractmethod
    def read(cls, rules: ClauseRules, children: Children) -> Self:
        """Builds the statement from the children of its grammar rule; errors are reported to `rules`."""

    @abstractmethod
    def declares(self) -> tuple[Name, ...]:
        """The names that it declares, including the name of the time or of a channel."""

    @abstractmethod
    def replaces(self) -> tuple[Key, ...]:
        """The keys of the statements that it replaces in an extended file."""

    @abstractmethod
    def places(self) -> Iterator[Place]:
        """All its expressions; the index of a target is not among them."""

    def formals(self) -> tuple[Name, ...]:
        """The parameters in parentheses behind its name, which are local to it."""
        return ()

    def outlined(self) -> tuple[tuple[str, Span], ...]:
        """The lines of an outline for it: each a text, and the place of the name."""
        return tuple((name.text, name.span) for name in self.declares())


class Declaration(StatementNode):
    """A statement that declares names in the namespace of expressions, and replaces earlier declarations of them."""

    def replaces(self) -> tuple[Key, ...]:
        """One key for each name."""
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
        """No names."""
        return ()

    def replaces(self) -> tuple[Key, ...]:
        """The kind of statement and its target."""
        return ((self.entry.word, target_text(self.target)),)

    def outlined(self) -> tuple[tuple[str, Span], ...]:
        """The target."""
        return ((target_text(self.target), self.target.span),)


class Formula(StatementNode):
    """A statement without numbers outside its expressions and without a column of the data."""


class Remark(StatementNode):
    """A statement without expressions, units and columns."""

    def declares(self) -> tuple[Name, ...]:
        """No names in the namespace of expressions."""
        return ()

    def places(self) -> Iterator[Place]:
        """No expressions."""
        return iter(())

    @abstractmethod
    def mentions(self) -> Iterator[Mention]:
        """All names in it."""

    def outlined(self) -> tuple[tuple[str, Span], ...]:
        """The names that it declares outside the namespace of expressions."""
        return tuple((found.name.text, found.name.span) for found in self.mentions() if found.declares)


def target_name(target: Name | Index) -> Name:
    """The name that a statement is about; for an element, the name of its array."""
    return target.array if isinstance(target, Index) else target


def target_text(target: Name | Index) -> str:
    """The target as a key: `X`, or `c[3]` without spaces."""
    return target.text if isinstance(target, Name) else "".join(target.span.text.split())


def fixed(*expressions: Expression | None) -> Iterator[Place]:
    """The places of expressions of numbers and constants only."""
    for expression in expressions:
        if expression is not None:
            yield Place(expression, CONSTANT)


def ends(interval: Interval | None) -> Iterator[Place]:
    """The places of the two ends of a range."""
    if interval is not None:
        yield from fixed(interval.low, interval.high)


def parameters(distribution: Distribution | None) -> Iterator[Place]:
    """The places of the parameters of a prior or a noise."""
    if distribution is not None:
        yield from fixed(*distribution.arguments)
