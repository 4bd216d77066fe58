"""`table`: a known function given by points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Argument, Name, Point, PointsFile, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Formula, Named, Place
from gbspec.syntax.transformer import Children, ClauseRules, tokens


@dataclass(frozen=True)
class TableStatement(Named, Formula):
    """`table ocv(soc) : V from "ocv.csv" pchip outside error`, or with `= (0, 3.2), (1, 4.2)` in place of the file."""

    entry = Entry(
        word="table",
        meaning="a known function of one or two arguments, given by points in a file or here",
        example='table ocv(soc) : V from "ocv.csv" pchip outside hold "open-circuit voltage"',
        title="tables",
        symbol="Function",
        kind=Kind.TABLE,
        role="function given by points",
        reserved=False,
    )
    arguments: tuple[Argument, ...]
    unit: UnitExpression | None = None
    file: PointsFile | None = None
    points: tuple[Point, ...] = ()
    interpolation: Literal["linear", "pchip", "cubic"] | None = None
    outside: Literal["hold", "error"] | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `table NAME(arguments)` and its clauses."""
        found = reader.gather(children, "a table")
        name = reader.declared(children[1])
        arguments = next((child for child in children if isinstance(child, tuple)), ())
        file, points = found.get("file"), found.get("points", ())
        head = reader.place(children[1], tokens(children, "RPAR")[0]).text
        if file is None and not points:
            reader.problem(
                "GB160",
                f"the table `{name.text}` has no points",
                reader.over(children),
                help=f'write `table {head} from "points.csv"`, or the points: `table {head} = (0, 1.5), (1, 2.5)`',
            )
        elif file is not None and points:
            reader.problem(
                "GB161",
                f"the table `{name.text}` has its points twice, from a file and here",
                points[0].span.to(points[-1].span),
                help="keep one of the two",
            )
        for argument in arguments:
            if argument.range is not None:
                reader.problem(
                    "GB162",
                    f"the points of the table `{name.text}` give the range of `{argument.name.text}`",
                    argument.range.span,
                    help="delete the range; `outside hold` or `outside error` says what holds beyond the points",
                )
        rest = (found.get(kind) for kind in ("method", "outside", "text"))
        return cls(reader.over(children), name, arguments, found.get("unit"), file, points, *rest)

    def places(self) -> Iterator[Place]:
        """No expressions."""
        return iter(())

    def formals(self) -> tuple[Name, ...]:
        """The arguments."""
        return tuple(argument.name for argument in self.arguments)
