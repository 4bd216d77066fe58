"""Arrays of states and rows of learnable constants, as they are declared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from gbspec.diagnostics import Span
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item
from gbspec.syntax import ast, children

MOST_ROUNDS = 20
"""How often constants that depend on branches of an `if` that are not taken are tried again."""


@dataclass
class DeclaredArray:
    """A declared array: its range of indices, and the expressions for elements beyond its ends.

    `row`: of constants or of algebraic variables (`algebraic`), which have no balances and no ends.
    """

    name: str
    span: Span
    first: int
    last: int
    row: bool = False
    algebraic: bool = False
    ends: dict[int, ast.ClosureStatement] = field(default_factory=dict)

    @property
    def range(self) -> str:
        """`1 to 512`."""
        return f"{self.first} to {self.last}"

    def element(self, index: int) -> str:
        """The name of the state or constant for an element."""
        return element_name(self.name, index)

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of all elements."""
        return tuple(self.element(i) for i in range(self.first, self.last + 1))


@dataclass(frozen=True)
class Declared:
    """The declaration of an array: its name, and the two ends of its indices."""

    name: ast.Name
    span: Span
    ends: tuple[ast.Expression, ast.Expression]
    row: bool = False
    algebraic: bool = False


def declarations(items: tuple[Item, ...]) -> Iterator[Declared]:
    """The arrays that a model declares."""
    for item in items:
        match item.statement:
            case ast.StateStatement(
                declarator=ast.Declarator(name=name, first=ast.Node() as first, last=ast.Node() as last)
            ):
                yield Declared(name, item.statement.declarator.span, (first, last))
            case ast.AlgebraicStatement(
                declarator=ast.Declarator(name=name, first=ast.Node() as first, last=ast.Node() as last)
            ):
                yield Declared(name, item.statement.declarator.span, (first, last), row=True, algebraic=True)
            case ast.LearnStatement(name=name, row=(first, last)):
                yield Declared(name, name.span.to(last.span), (first, last), row=True)
            case _:
                pass


def element_name(name: str, index: int) -> str:
    """The name of the element of an array."""
    return f"{name}_{index}" if index >= 0 else f"{name}_m{-index}"


def indexed_by(
    statement: ast.EquationStatement, loop: str | None, arrays: Mapping[str, DeclaredArray]
) -> DeclaredArray | None:
    """The array over whose elements an equation runs: of those indexed by `loop` alone the first algebraic one, else
    the first."""
    parts = (part for side in (statement.left, statement.right) for part in walk(side))
    found = [
        arrays[part.array.text]
        for part in parts
        if isinstance(part, ast.Index)
        and isinstance(part.index, ast.Name)
        and part.index.text == loop
        and part.array.text in arrays
    ]
    return next((array for array in found if array.algebraic), found[0] if found else None)


def mentions_index(statement: ast.Statement) -> bool:
    """Whether indices or sums of arrays occur in a statement."""
    return any(
        isinstance(part, ast.Index | ast.ClosureStatement) or is_sum(part)
        for root in (statement, *children(statement))
        for part in (walk(root) if isinstance(root, ast.Expression) else (root,))
    )


def is_sum(node: ast.Node) -> bool:
    """Whether it is `sum(c)`."""
    return isinstance(node, ast.Call) and node.function.text == "sum"


def is_place(node: ast.Expression) -> bool:
    """Whether it is a name, an element, a rate or a sum: what expansion may replace."""
    return isinstance(node, ast.Name | ast.Index | ast.RateOf) or is_sum(node)


def summed(node: ast.Node) -> tuple[str, ...]:
    """The array of `sum(c)`."""
    if isinstance(node, ast.Call) and is_sum(node):
        return tuple(argument.text for argument in node.arguments if isinstance(argument, ast.Name))
    return ()


def constant_values(items: tuple[Item, ...], functions: Mapping[str, ast.FunctionStatement]) -> dict[str, float]:
    """The values of the constants that can be evaluated; errors in the others are reported later."""
    statements = [i.statement for i in items if isinstance(i.statement, ast.ConstStatement)]
    declared = {statement.name.text for statement in statements}
    values: dict[str, float] = {}
    evaluate = Evaluator(values, functions)
    users: dict[str, list[int]] = {}
    lacking: list[int] = []  # of each statement: how many of the constants in it are not known yet
    for number, statement in enumerate(statements):
        names = {n.text for n in walk(statement.value) if isinstance(n, ast.Name)} & declared
        lacking.append(len(names))
        for name in names:
            users.setdefault(name, []).append(number)
    ready = [number for number, count in enumerate(lacking) if not count]
    while ready:  # each is evaluated once, so that a long chain takes linear time
        statement = statements[ready.pop()]
        if statement.name.text in values or (value := evaluate(statement.value)) is None:
            continue
        values[statement.name.text] = value
        for user in users.get(statement.name.text, ()):
            lacking[user] -= 1
            if not lacking[user]:
                ready.append(user)
    for _ in range(MOST_ROUNDS):  # an `if` may have a value though one of its branches has none
        before = len(values)
        for statement in statements:
            if statement.name.text not in values and (value := evaluate(statement.value)) is not None:
                values[statement.name.text] = value
        if len(values) == before:
            break
    return values
