"""The nodes that statements consist of: expressions, units, clauses; each with its place in the text.

Nothing here knows what a name means. Numbers keep their text so that the formatter writes them as they were.

Nesting (brackets, signs, powers) is limited to `MAX_DEPTH` by the parser, but a sum or product may have thousands of
terms, each `Binary` holding the terms before it on its left: go through trees with `gbspec.syntax.walking` (`walk`,
`fold`, `same`), not by recursion into `Binary.left`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gbspec.diagnostics import Span

MAX_DEPTH = 100
"""How deep expressions may nest, not counting the terms of a sum and the factors of a product."""


@dataclass(frozen=True)
class Node:
    """Anything with a place in the text."""

    span: Span


# ---------------------------------------------------------------------------------------------------- expressions


@dataclass(frozen=True)
class Number(Node):
    """A literal; `value` is `float(text)`."""

    text: str

    @property
    def value(self) -> float:
        """The number, as the nearest double."""
        return float(self.text)


@dataclass(frozen=True)
class Name(Node):
    """A name, after NFKC."""

    text: str


@dataclass(frozen=True)
class Quoted(Name):
    """A text in quotes beside `==`, or in a list of categories: the name of a category."""


@dataclass(frozen=True)
class Call(Node):
    """`f(a, b)`: a function of the language, a declared function or unknown, `net(X)`, or `sum(c)`."""

    function: Name
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class Index(Node):
    """`c[i - 1]`."""

    array: Name
    index: Expression


@dataclass(frozen=True)
class RateOf(Node):
    """`X'` in an expression: the rate of change of a state, which stands for the right side of its balance."""

    target: Name | Index


@dataclass(frozen=True)
class Unary(Node):
    """`-a`, `+a`, or (in a condition) `not a`."""

    operator: Literal["-", "+", "not"]
    operand: Expression


@dataclass(frozen=True)
class Binary(Node):
    """Arithmetic; `**` is read as `^`."""

    operator: Literal["+", "-", "*", "/", "^"]
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Comparison(Node):
    """One comparison inside a condition."""

    operator: Literal["<", "<=", ">", ">=", "=="]
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Logic(Node):
    """`a and b`, `a or b` inside a condition."""

    operator: Literal["and", "or"]
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Conditional(Node):
    """`if(condition, a, b)`."""

    condition: Expression
    then: Expression
    otherwise: Expression


@dataclass(frozen=True)
class Group(Node):
    """`(a)`: kept so that the formatter writes parentheses as the user did; its value is that of `a`."""

    inner: Expression


@dataclass(frozen=True)
class Conversion(Node):
    """`3.2 in mH`: a number in a unit, or the value of an expression in another unit of its kind."""

    value: Expression
    unit: UnitExpression


Expression = (
    Number | Name | Call | Index | RateOf | Unary | Binary | Comparison | Logic | Conditional | Group | Conversion
)


# ---------------------------------------------------------------------------------------------------------- units


@dataclass(frozen=True)
class UnitName(Node):
    """A unit by name."""

    text: str


@dataclass(frozen=True)
class UnitNumber(Node):
    """A number within a unit (`1/h`, `10^3 L`)."""

    text: str


@dataclass(frozen=True)
class UnitBinary(Node):
    """A product, quotient or power of units; the right side of `^` is a (signed) number."""

    operator: Literal["*", "/", "^"]
    left: UnitExpression
    right: UnitExpression


UnitExpression = UnitName | UnitNumber | UnitBinary


# ----------------------------------------------------------------------------------------------- parts of statements


@dataclass(frozen=True)
class Text(Node):
    """A string; `value` without its quotes."""

    value: str


@dataclass(frozen=True)
class Interval(Node):
    """`in [low, high]`."""

    low: Expression
    high: Expression


@dataclass(frozen=True)
class Categories(Node):
    """`in {"wild type", mutant}`: the categories of a condition."""

    names: tuple[Name, ...]


@dataclass(frozen=True)
class Bound(Node):
    """`>= e`, `<= e`, `> e`, `< e` after a learnable or an unknown; `name` selects one of several outputs."""

    operator: Literal[">", ">=", "<", "<="]
    value: Expression
    name: Name | None = None


@dataclass(frozen=True)
class RangeContract(Node):
    """`in [lo, hi]` on an unknown's output."""

    interval: Interval
    name: Name | None = None


@dataclass(frozen=True)
class ZeroAt(Node):
    """`zero at v = e` on an unknown."""

    argument: Name
    value: Expression
    name: Name | None = None


@dataclass(frozen=True)
class EqualsAt(Node):
    """`equals e at v = e` on an unknown."""

    value: Expression
    argument: Name
    place: Expression
    name: Name | None = None


Shape = Literal["increasing", "decreasing", "convex", "concave", "odd", "even"]
"""How a function depends on one of its arguments."""


@dataclass(frozen=True)
class Shaped(Node):
    """`increasing in v`, `convex in v`, `odd in v`, … on an unknown."""

    shape: Shape
    argument: Name
    name: Name | None = None


@dataclass(frozen=True)
class Periodic(Node):
    """`period 24 in v` on an unknown."""

    period: Expression
    argument: Name
    name: Name | None = None


Contract = Bound | RangeContract | ZeroAt | EqualsAt | Shaped | Periodic


@dataclass(frozen=True)
class Distribution(Node):
    """`normal(3, 0.5)` or `lognormal(...)` of a prior or a noise, `student(0.1, 5)` or
    `poisson` of a noise."""

    kind: Name
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class Grouping(Node):
    """`per trajectory`, or `per trajectory ~ lognormal(s)`: `column` names the groups, `spread` how values differ
    between them (without arguments: learned)."""

    column: Text
    spread: Distribution | None = None


@dataclass(frozen=True)
class Assignment(Node):
    """`X = e` in an event: the value of X after it."""

    target: Name | Index
    value: Expression


@dataclass(frozen=True)
class Option(Node):
    """`activation=silu` among a network's arguments."""

    name: Name
    value: Expression


@dataclass(frozen=True)
class NetworkSpec(Node):
    """`by mlp(32, 32, activation=silu)`."""

    kind: Name
    widths: tuple[Expression, ...]
    options: tuple[Option, ...]


@dataclass(frozen=True)
class Argument(Node):
    """A formal argument of an unknown: `g : mg/L in [0, 5]`, unit and range optional."""

    name: Name
    unit: UnitExpression | None = None
    range: Interval | None = None


@dataclass(frozen=True)
class Point(Node):
    """`(0.5, 3.7)`: a point of a table, its arguments and then the value."""

    numbers: tuple[Number, ...]


@dataclass(frozen=True)
class PointsFile(Node):
    """`from "ocv.csv"` of a table."""

    path: Text


@dataclass(frozen=True)
class Declarator(Node):
    """A declared name, with the index range if it is an array: `c[1..N]`."""

    name: Name
    first: Expression | None = None
    last: Expression | None = None
