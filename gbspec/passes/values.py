"""Values at places, `equals e at v = e0`: a known function with these values, plus one that is 0 at the places."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import sympy

from gbspec.ir import Expr, Unknown
from gbspec.passes.monotone import monotone
from gbspec.passes.requirements import Value, Wanted, Zero
from gbspec.passes.shapes import Refused, shown, symmetric
from gbspec.passes.signs import Prover


def with_offset(
    unknown: Unknown, formals: Sequence[sympy.Symbol], demands: Wanted, prover: Prover
) -> tuple[Expr, Wanted]:
    """The known function, and what is required of the rest: zeros in place of values, bounds from the function.

    Raises:
        Refused: GB603 if values contradict each other or a bound, GB607 if no construction is known.
    """
    if not demands.values:
        return sympy.S.Zero, demands
    points = [*demands.values, *(Value(z.argument, z.value, z.contract) for z in demands.zeros)]
    _distinct(unknown, formals, points, prover)
    offset = points[0].to
    if any(point.to != offset for point in points):
        offset = _through(unknown, formals, points, demands, prover)
    contracts = [point.contract for point in points]
    _fits(unknown, formals, offset, demands, prover)
    ends = []
    for bound, side in ((demands.lower, 1), (demands.upper, -1)):
        ends.append(None if bound is None else bound - offset)
        if bound is not None and prover.positive(side * (bound - offset)):
            word = "at least" if side > 0 else "at most"
            raise Refused(
                "GB603",
                f"`{unknown.name}` cannot be {word} `{shown(bound)}` and equal `{shown(offset)}`",
                [*contracts, *(c for c in unknown.contracts if c.kind in ("lower", "upper"))],
                "correct the value or the bound",
            )
    zeros = tuple(Zero(point.argument, point.value, point.contract) for point in points)
    return offset, Wanted(ends[0], ends[1], zeros, demands.shapes)


def _distinct(unknown: Unknown, formals: Sequence[sympy.Symbol], points: Sequence[Value], prover: Prover) -> None:
    for one, other in itertools.combinations(points, 2):
        if one.argument != other.argument or one.to == other.to:
            continue
        if prover.zero(one.value - other.value):
            raise Refused(
                "GB603",
                f"`{unknown.name}` has two values at `{formals[one.argument].name} = {shown(one.value)}`",
                [other.contract, one.contract],
                "delete one of them",
            )


def _through(
    unknown: Unknown, formals: Sequence[sympy.Symbol], points: Sequence[Value], demands: Wanted, prover: Prover
) -> Expr:
    """The polynomial of least degree through different values at several places of one argument."""
    contracts = [point.contract for point in points]
    shapes = demands.shapes
    if demands.bounded or shapes.beyond or shapes.directions or len({point.argument for point in points}) > 1:
        raise Refused(
            "GB607",
            f"different values of `{unknown.name}` at several places have a construction only in one argument, and"
            " without bounds, directions and other shapes",
            contracts,
            "keep one of the values, or write a postulate that has them and vanishes nowhere else: `= f + g*nn`",
        )
    v, offset = formals[points[0].argument], sympy.S.Zero
    for point in points:
        others = [other for other in points if other is not point]
        apart = [point.value - other.value for other in others]
        if not all(prover.positive(d) or prover.positive(-d) for d in apart):
            raise Refused(
                "GB607",
                f"the places where `{unknown.name}` has different values are not proved to be different",
                contracts,
                "use numbers, or bound the constants in them",
            )
        offset += point.to * sympy.Mul(*((v - o.value) / d for o, d in zip(others, apart, strict=True)))
    return offset


def _fits(
    unknown: Unknown,
    formals: Sequence[sympy.Symbol],
    offset: Expr,
    demands: Wanted,
    prover: Prover,
) -> None:
    """Raises `Refused` if the known function does not have the asked shapes."""
    shapes, used = demands.shapes, offset.free_symbols
    wrong = [i for i in shapes.curvatures if formals[i] in used]
    wrong += [i for i, way in shapes.directions.items() if not monotone(prover, offset, formals[i], way)]
    wrong += [i for i, parity in shapes.parities.items() if parity < 0 and offset != 0]
    if wrong or not symmetric(offset, formals, replace(shapes, parities={})):
        name = formals[wrong[0]].name if wrong else "its periodic argument"
        raise Refused(
            "GB607",
            f"`{unknown.name}` equals `{shown(offset)}` at a place, which is not proved to have the shape that is"
            f" asked for in `{name}`",
            [point.contract for point in (*demands.values, *demands.zeros)],
            "use a value that does not depend on this argument (an odd function can only be 0 at 0)",
        )
