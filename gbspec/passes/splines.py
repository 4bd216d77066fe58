"""Cubic splines in place of a network: the raw output as an expression in coefficients, the network's biases.

Of one argument, with u its place among m = K - 3 equal intervals of its range (held beyond): S_k(u) rises from 0 at
k - 3 to 1 at k, the sum of the cubic B-splines from the k-th on; and T_l is the sum of the S_k from the l-th on. Then
`r_0 + r_1 T_1/(K - 1) + sum r_l T_l` is any cubic spline on these knots, and r_l for l >= 2 are second differences of
its coefficients, which have a prior. With a direction: `r_0 + sum softplus(r_1 + ... + r_k) S_k`. Of two arguments,
each r is a spline of the other argument.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import sympy

from gbspec.ir import Expr, Network, Unknown, softplus
from gbspec.passes.cores import Cores
from gbspec.passes.intervals import Box
from gbspec.passes.shapes import Refused, Shapes


class SplineCores(Cores):
    """The raw outputs of an unknown that is a spline."""

    def __init__(
        self, unknown: Unknown, network: Network, formals: Sequence[sympy.Symbol], first_gate: int, ranges: Box
    ) -> None:
        super().__init__(formals, first_gate)
        self.sizes = network.spline
        self.ends = [_ends(unknown, f, ranges) for f in formals]
        self._gates: dict[int, list[int]] = {}

    def checked(self, unknown: Unknown, shapes: Shapes) -> None:
        """Raises `Refused` for shapes that splines do not offer."""
        if shapes.beyond or len(shapes.directions) > 1:
            kinds = ("convex", "concave", "odd", "even", "period", "increasing", "decreasing")
            what = "two directions" if not shapes.beyond else "a curvature, a symmetry or a period"
            raise Refused(
                "GB607",
                f"`{unknown.name}` is a spline, for which {what} has no construction",
                [c for c in unknown.contracts if c.kind in kinds],
                "leave the contract out, or write `by mlp(32, 32)`",
            )

    def at(self, point: Sequence[Expr], output: int) -> Expr:
        """The spline at a point."""
        if output not in self._gates:
            count = 1
            for size in self.sizes:
                count *= size
            self._gates[output] = gates = [output, *(self.gate() for _ in range(count - 1))]
            places = itertools.product(
                *(range(size) for size in (self.sizes if self._first() == 0 else self.sizes[::-1]))
            )
            self.smooth += tuple(gate for gate, place in zip(gates, places, strict=True) if max(place) >= 2)
        direction, first = next(iter(self.shapes.directions.items()), None), self._first()
        second = [_sums(_steps(self._place(point, i), self.sizes[i])) for i in range(len(point)) if i != first]
        width = self.sizes[1 - first] if second else 1
        inner = second[0] if second else [sympy.S.One]
        free = [self._raw(self.formals, gate) for gate in self._gates[output]]
        rows = [sympy.Add(*(free[i * width + j] * inner[j] for j in range(width))) for i in range(self.sizes[first])]
        steps = _steps(self._place(point, first), self.sizes[first])
        if direction is None:
            return sympy.Add(*(row * part for row, part in zip(rows, _sums(steps), strict=True)))
        total, rise = rows[0], sympy.S.Zero
        for row, step in zip(rows[1:], steps, strict=True):
            rise += row
            total += sympy.Float(direction[1] * 2.0 / len(steps)) * softplus(rise) * step
        return total

    def _first(self) -> int:
        """The argument whose coefficients are splines of the other."""
        return next(iter(self.shapes.directions), 0)

    def _place(self, point: Sequence[Expr], i: int) -> Expr:
        low, high = self.ends[i]
        share = (point[i] - low) / (high - low)
        return sympy.Max(sympy.Min(share, 1), 0) * (self.sizes[i] - 3)


def _steps(u: Expr, size: int) -> list[Expr]:
    """S_1 to S_(size - 1)."""
    found = []
    for k in range(1, size):
        t = sympy.Max(sympy.Min(u - (k - 3), 3), 0)
        found.append((t**3 - 3 * sympy.Max(t - 1, 0) ** 3 + 3 * sympy.Max(t - 2, 0) ** 3) / 6)
    return found


def _sums(steps: Sequence[Expr]) -> list[Expr]:
    """1, T_1/(K - 1), T_2, ..."""
    found, total = [], sympy.S.Zero
    for step in reversed(steps):
        total += step
        found.append(total)
    found.reverse()
    return [sympy.S.One, found[0] / len(steps), *found[1:]]


def _ends(unknown: Unknown, formal: sympy.Symbol, ranges: Box) -> tuple[Expr, Expr]:
    interval = ranges.get(formal)
    if interval is None or not (-1e300 < interval.low < interval.high < 1e300):
        raise Refused(
            "GB610",
            f"`{unknown.name}` is a spline, so that its argument `{formal.name}` needs a range",
            [],
            f"write `{formal.name} in [0, 10]` in the parentheses",
        )
    return sympy.Float(interval.low), sympy.Float(interval.high)
