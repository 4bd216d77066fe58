"""The abstract syntax of a `.gb` file: what was written, with the place of every part.

Nothing here knows what a name means. Numbers keep their text so that the formatter writes them as they were.

Nesting (brackets, signs, powers) is limited to `MAX_DEPTH` by the parser, but a sum or product may have thousands of
terms, each `Binary` holding the terms before it on its left: go through trees with `gbspec.syntax.walking` (`walk`,
`fold`, `same`), not by recursion into `Binary.left`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from gbspec.syntax.nodes import (
    MAX_DEPTH,
    Argument,
    Assignment,
    Binary,
    Bound,
    Call,
    Comparison,
    Conditional,
    Contract,
    Conversion,
    Declarator,
    Distribution,
    EqualsAt,
    Expression,
    Group,
    Grouping,
    Index,
    Interval,
    Logic,
    Name,
    NetworkSpec,
    Node,
    Number,
    Option,
    Periodic,
    Point,
    PointsFile,
    Quoted,
    RangeContract,
    RateOf,
    Shape,
    Shaped,
    Text,
    Unary,
    UnitBinary,
    UnitExpression,
    UnitName,
    UnitNumber,
    ZeroAt,
)
from gbspec.syntax.statements import (
    About,
    AlgebraicStatement,
    AllowStatement,
    BalanceStatement,
    ClosureStatement,
    ConditionStatement,
    ConserveStatement,
    ConstStatement,
    CorrelateStatement,
    DiffusionStatement,
    DiscreteStatement,
    DoseStatement,
    EffectStatement,
    EquationStatement,
    EventStatement,
    Formula,
    FunctionStatement,
    HistoryStatement,
    InitialStatement,
    InputStatement,
    LearnStatement,
    LetStatement,
    Mention,
    ModelStatement,
    ObserveStatement,
    ProcessStatement,
    Remark,
    StateStatement,
    SteadyStatement,
    TableStatement,
    TimeStatement,
    TruthStatement,
    UnitStatement,
    UnknownStatement,
    WithoutStatement,
)

__all__ = [
    "MAX_DEPTH",
    "RESERVED",
    "STATEMENTS",
    "WORDS",
    "About",
    "AlgebraicStatement",
    "AllowStatement",
    "Argument",
    "Assignment",
    "BalanceStatement",
    "Binary",
    "Bound",
    "Call",
    "ClosureStatement",
    "Comparison",
    "ConditionStatement",
    "Conditional",
    "ConserveStatement",
    "ConstStatement",
    "Contract",
    "Conversion",
    "CorrelateStatement",
    "Declarator",
    "DiffusionStatement",
    "DiscreteStatement",
    "Distribution",
    "DoseStatement",
    "EffectStatement",
    "EqualsAt",
    "EquationStatement",
    "EventStatement",
    "Expression",
    "File",
    "Formula",
    "FunctionStatement",
    "Group",
    "Grouping",
    "HistoryStatement",
    "Index",
    "InitialStatement",
    "InputStatement",
    "Interval",
    "LearnStatement",
    "LetStatement",
    "Logic",
    "Mention",
    "ModelStatement",
    "Name",
    "NetworkSpec",
    "Node",
    "Number",
    "ObserveStatement",
    "Option",
    "Periodic",
    "Point",
    "PointsFile",
    "ProcessStatement",
    "Quoted",
    "RangeContract",
    "RateOf",
    "Remark",
    "Shape",
    "Shaped",
    "StateStatement",
    "Statement",
    "SteadyStatement",
    "TableStatement",
    "Text",
    "TimeStatement",
    "TruthStatement",
    "Unary",
    "UnitBinary",
    "UnitExpression",
    "UnitName",
    "UnitNumber",
    "UnitStatement",
    "UnknownStatement",
    "WithoutStatement",
    "ZeroAt",
]

Statement = (
    ModelStatement
    | TimeStatement
    | UnitStatement
    | StateStatement
    | ConditionStatement
    | InputStatement
    | ConstStatement
    | LearnStatement
    | EffectStatement
    | CorrelateStatement
    | LetStatement
    | FunctionStatement
    | TableStatement
    | UnknownStatement
    | ProcessStatement
    | BalanceStatement
    | ClosureStatement
    | InitialStatement
    | SteadyStatement
    | ObserveStatement
    | DoseStatement
    | DiffusionStatement
    | DiscreteStatement
    | EventStatement
    | AlgebraicStatement
    | EquationStatement
    | HistoryStatement
    | ConserveStatement
    | TruthStatement
    | AllowStatement
    | WithoutStatement
)
"""Every kind of statement, in the order in which the documentation lists them."""

STATEMENTS: tuple[type[Statement], ...] = get_args(Statement)

WORDS: tuple[str, ...] = tuple(kind.entry.word for kind in STATEMENTS if kind.entry.spelled)
"""The words that begin a statement."""

RESERVED = frozenset(kind.entry.word for kind in STATEMENTS if kind.entry.spelled and kind.entry.reserved)
"""Those that no state may be called."""


@dataclass(frozen=True)
class File(Node):
    """All statements of one file that could be read, in the order of the text.

    `uncertain` are the names that occur in statements with syntax errors (already reported). Whether they are declared
    is not known, so that later checks report nothing about them.
    """

    statements: tuple[Statement, ...]
    uncertain: frozenset[str] = frozenset()
