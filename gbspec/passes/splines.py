"""Cubic splines in place of a network: the raw output as an expression in coefficients, the network's biases.

Of one argument, with u its place among m = K - 3 equal intervals of its range (held beyond): S_k(u) rises from 0 at
k - 3 to 1 at k, the sum of the cubic B-splines from the k-th on; and T_l is the sum of the S_k from the l-th on. Then
`r_0 + r_1 T_1/(K - 1) + sum r_l T_l` is any cubic spline on these knots, and r_l for l >= 2 are second differences of
its coefficients, which have a prior. With a direction: `r_0 + sum softplus(r_1 + ... + r_k) S_k`. Of two arguments,
each r is a spline of the other argument.

The trained biases are r over its unit (`_unit`). The second derivative of an integrated Wiener process with intensity
s^2, of which a smoothing spline is the most probable path (Wahba 1978), changes the second differences of coefficients
at a distance h by deviations of s h^1.5. In this unit the number of coefficients does not change what a prior means,
the ridge of the evidence estimates s, and leaves the level and the slope, whose unit is larger, almost free.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import sympy

from gbspec.ir import Expr, Network, Unknown, softplus
from gbspec.passes.cores import Cores
from gbspec.passes.intervals import Box
from gbspec.passes.shapes import Refused, Shapes

LEVEL = 10.0
"""The unit of levels and slopes, in units of the function's scale, and of s: with a prior of width 1, level and
slope may be far from those of the scale's center, and the function may turn about twice within its range."""


class SplineCores(Cores):
    """The raw outputs of an unknown that is a spline."""

    def __init__(
        self, unknown: Unknown, network: Network, formals: Sequence[sympy.Symbol], first_gate: int, ranges: Box
    ) -> None:
        super().__init__(formals, first_gate)
        self.sizes = network.spline
        self.ends = [_ends(unknown, f, ranges) for f in formals]
        self.between = network.between
        self._gates: dict[int, list[int]] = {}
        self._extra: dict[int, list[int]] = {}

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
        total = self._spline(point, output)
        return total + self._finer(point, output) if self.between else total

    def _spline(self, point: Sequence[Expr], output: int) -> Expr:
        if output not in self._gates:
            count = 1
            for size in self.sizes:
                count *= size
            self._gates[output] = gates = [output, *(self.gate() for _ in range(count - 1))]
            self.smooth += tuple(gate for gate, place in zip(gates, self._places(), strict=True) if max(place) >= 2)
        direction, first = next(iter(self.shapes.directions.items()), None), self._first()
        second = [_sums(_steps(self._place(point, i), self.sizes[i])) for i in range(len(point)) if i != first]
        width = self.sizes[1 - first] if second else 1
        inner = second[0] if second else [sympy.S.One]
        free = [
            sympy.Float(self._unit(place)) * self._raw(self.formals, gate)
            for gate, place in zip(self._gates[output], self._places(), strict=True)
        ]
        rows = [sympy.Add(*(free[i * width + j] * inner[j] for j in range(width))) for i in range(self.sizes[first])]
        steps = _steps(self._place(point, first), self.sizes[first])
        if direction is None:
            return sympy.Add(*(row * part for row, part in zip(rows, _sums(steps), strict=True)))
        total, rise = rows[0], sympy.S.Zero
        for row, step in zip(rows[1:], steps, strict=True):
            rise += row
            total += sympy.Float(direction[1] * 2.0 / len(steps)) * softplus(rise) * step
        return total

    def _finer(self, point: Sequence[Expr], output: int) -> Expr:
        """What a spline on knots at half the distance has beyond this one: a B-spline in the middle of each interval of
        an argument."""
        if output not in self._extra:
            self._extra[output] = [self.gate() for size in self.sizes for _ in range(size - 3)]
            self.extra += tuple(self._extra[output])
        places = [(self._place(point, i), k) for i, size in enumerate(self.sizes) for k in range(size - 3)]
        free = [self._raw(self.formals, gate) for gate in self._extra[output]]
        return sympy.Add(*(raw * _bump(2 * (u - k) - 1) for raw, (u, k) in zip(free, places, strict=True)))

    def _places(self) -> list[tuple[int, ...]]:
        """The place of each coefficient in each argument, that of the rows first."""
        return list(itertools.product(*map(range, self._ordered())))

    def _ordered(self) -> tuple[int, ...]:
        return self.sizes if self._first() == 0 else self.sizes[::-1]

    def _unit(self, place: tuple[int, ...]) -> float:
        """The raw coefficient at a place that one of its bias stands for.

        With a direction, r_l (l >= 2) is a difference of successive slopes, K - 1 times that of coefficients.
        """
        unit = LEVEL
        for i, (k, size) in enumerate(zip(place, self._ordered(), strict=True)):
            if k >= 2:
                unit *= (size - 3) ** (-0.5 if i == 0 and self.shapes.directions else -1.5)
        return unit

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


def _bump(u: Expr) -> Expr:
    """The cubic B-spline on the knots -2 to 2."""
    distance = sympy.Abs(u)
    return (sympy.Max(2 - distance, 0) ** 3 - 4 * sympy.Max(1 - distance, 0) ** 3) / 6


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
