"""The abstract syntax of a `.gb` file: what was written, with the place of every part.

Nothing here knows what a name means. Numbers keep their text so that the formatter writes them as they were.

Nesting (brackets, signs, powers) is limited to `MAX_DEPTH` by the parser, but a sum or product may have thousands of
terms, each `Binary` holding the terms before it on its left: go through trees with `gbspec.syntax.walk` (`walk`,
`fold`, `same`), not by recursion into `Binary.left`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gbspec.diagnostics import Span

MAX_DEPTH = 100
"""How deep expressions may nest, the terms of a sum and the factors of a product not counted."""


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
    """`(a)`: kept so that the formatter writes parentheses as the user did; means its inner expression."""

    inner: Expression


Expression = Number | Name | Call | Index | Unary | Binary | Comparison | Logic | Conditional | Group


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
class Bound(Node):
    """`>= e`, `<= e`, `> e`, `< e` after a learnable or an unknown; `name` when one of several outputs is meant."""

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
class Monotone(Node):
    """`increasing in v` / `decreasing in v` on an unknown."""

    direction: Literal["increasing", "decreasing"]
    argument: Name
    name: Name | None = None


Contract = Bound | RangeContract | ZeroAt | Monotone


@dataclass(frozen=True)
class Distribution(Node):
    """`normal(3, 0.5)` or `lognormal(...)` of a prior or a noise."""

    kind: Name
    arguments: tuple[Expression, ...]


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


# ------------------------------------------------------------------------------------------------------- statements


@dataclass(frozen=True)
class ModelStatement(Node):
    """`model NAME "title" [extends "other.gb"]`."""

    name: Name
    title: Text | None = None
    extends: Text | None = None


@dataclass(frozen=True)
class TimeStatement(Node):
    """`time t : h [from 0]`."""

    name: Name
    unit: UnitExpression | None = None
    start: Expression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class UnitStatement(Node):
    """`unit gX "gram of biomass"`."""

    name: Name
    description: Text | None = None


@dataclass(frozen=True)
class Declarator(Node):
    """A declared name, with the index range where it is an array: `c[1..N]`."""

    name: Name
    first: Expression | None = None
    last: Expression | None = None


@dataclass(frozen=True)
class StateStatement(Node):
    """`state X : gX/L in [0, 50] = 0.1 "biomass"`."""

    declarator: Declarator
    unit: UnitExpression | None = None
    range: Interval | None = None
    start: Expression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class ConditionStatement(Node):
    """`condition Da in [0.2, 0.5] = 0.3 as "column"`."""

    name: Name
    unit: UnitExpression | None = None
    range: Interval | None = None
    default: Expression | None = None
    column: Text | None = None
    description: Text | None = None


@dataclass(frozen=True)
class InputStatement(Node):
    """`input F : L/h held`; `interpolation` is None where the user left it out (which is an error later)."""

    name: Name
    unit: UnitExpression | None = None
    range: Interval | None = None
    interpolation: Literal["held", "linear"] | None = None
    default: Expression | None = None
    column: Text | None = None
    description: Text | None = None


@dataclass(frozen=True)
class ConstStatement(Node):
    """`const B = 11`."""

    name: Name
    value: Expression
    unit: UnitExpression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class LearnStatement(Node):
    """`learn beta = 1 in [0, 10] prior normal(3, 0.5) per trajectory`."""

    name: Name
    unit: UnitExpression | None = None
    start: Expression | None = None
    range: Interval | None = None
    bounds: tuple[Bound, ...] = ()
    prior: Distribution | None = None
    per_trajectory: bool = False
    description: Text | None = None


@dataclass(frozen=True)
class LetStatement(Node):
    """`let r = k*exp(-E/T)`."""

    name: Name
    value: Expression
    unit: UnitExpression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class FunctionStatement(Node):
    """`function monod(s, K) = s/(K + s)`."""

    name: Name
    parameters: tuple[Name, ...]
    value: Expression
    description: Text | None = None


@dataclass(frozen=True)
class UnknownStatement(Node):
    """`unknown a, b(x, y) : u contracts = postulate by mlp(32)`."""

    names: tuple[Name, ...]
    arguments: tuple[Argument, ...]
    units: tuple[UnitExpression, ...] = ()
    contracts: tuple[Contract, ...] = ()
    postulates: tuple[Expression, ...] = ()
    network: NetworkSpec | None = None
    description: Text | None = None


@dataclass(frozen=True)
class ProcessStatement(Node):
    """`process growth: 1/Y*S -> X rate mu(S)*X`; an empty side is None."""

    name: Name
    consumed: Expression | None
    produced: Expression | None
    rate: Expression
    description: Text | None = None


@dataclass(frozen=True)
class BalanceStatement(Node):
    """`X' = net(X) - D*X`, or `c[i]' = …` for every i."""

    target: Name | Index
    value: Expression
    description: Text | None = None


@dataclass(frozen=True)
class ClosureStatement(Node):
    """`c[0] = cin`: an end of an array of states."""

    target: Index
    value: Expression


@dataclass(frozen=True)
class InitialStatement(Node):
    """`initial X = expr`; `initial X learn` has no value."""

    target: Name | Index
    value: Expression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class ObserveStatement(Node):
    """`observe y = expr : unit noise normal(0.05) as "OD 600"`; `observe X` and `observe c[3]` have no value."""

    target: Name | Index
    value: Expression | None = None
    unit: UnitExpression | None = None
    noise: Distribution | None = None
    column: Text | None = None
    description: Text | None = None


@dataclass(frozen=True)
class DoseStatement(Node):
    """`dose S times F lag tlag`."""

    target: Name | Index
    fraction: Expression | None = None
    lag: Expression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class ConserveStatement(Node):
    """`conserve total = X + S/Yxs rate r`."""

    name: Name
    value: Expression
    rate: Expression | None = None
    description: Text | None = None


@dataclass(frozen=True)
class TruthStatement(Node):
    """`truth beta = 3`, `truth phi(x1, x2, Da) = …` (parameters None where there are no parentheses)."""

    name: Name
    value: Expression
    parameters: tuple[Name, ...] | None = None


@dataclass(frozen=True)
class AllowStatement(Node):
    """`allow GB401 NAME`."""

    code: Name
    name: Name | None = None


@dataclass(frozen=True)
class WithoutStatement(Node):
    """`without observe x2` (kind "observe"), `without k` (kind None: the declaration of that name)."""

    kind: Name | None
    name: Name


Statement = (
    ModelStatement
    | TimeStatement
    | UnitStatement
    | StateStatement
    | ConditionStatement
    | InputStatement
    | ConstStatement
    | LearnStatement
    | LetStatement
    | FunctionStatement
    | UnknownStatement
    | ProcessStatement
    | BalanceStatement
    | ClosureStatement
    | InitialStatement
    | ObserveStatement
    | DoseStatement
    | ConserveStatement
    | TruthStatement
    | AllowStatement
    | WithoutStatement
)


@dataclass(frozen=True)
class File(Node):
    """All statements of one file that could be read, in the order of the text.

    `uncertain` are the names that stand in statements which could not be read (they are reported already): whether and
    as what these are declared is not known, so that nothing should be said of them.
    """

    statements: tuple[Statement, ...]
    uncertain: frozenset[str] = frozenset()
