"""Raw outputs of a network that are even, odd or periodic in an argument, for all weights.

Even: the mean of the values at v and -v; odd: half their difference. Period T: with a = 2 pi v/T, the network gets
cos(a) in place of v, and `(1 + sin a)/2 A + (1 - sin a)/2 B` of two of its outputs: every smooth function of period T
is such a combination, and it has the directions and curvatures in other arguments that A and B have. Even or odd too:
`A`, or `sin(a) A`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import sympy

from gbspec.ir import Expr, raw
from gbspec.passes.shapes import Shapes


class Cores:
    """The raw outputs of one unknown, and the evaluations of the network that they need."""

    def __init__(self, formals: Sequence[sympy.Symbol], first_gate: int) -> None:
        self.formals, self.first_gate, self.gates = tuple(formals), first_gate, 0
        self.shapes = Shapes()
        self.smooth: tuple[int, ...] = ()
        self.extra: tuple[int, ...] = ()
        self.evaluations: list[tuple[Expr, ...]] = []
        self._partners: dict[tuple[int, int], int] = {}

    def gate(self) -> int:
        """The number of an extra output of the network."""
        self.gates += 1
        return self.first_gate + self.gates - 1

    def at(self, point: Sequence[Expr], output: int) -> Expr:
        """An output at a point, with the asked symmetries."""
        total: Expr = sympy.S.Zero
        parities = {i: p for i, p in self.shapes.parities.items() if i not in self.shapes.periods}
        for turned in itertools.product((1, -1), repeat=len(parities)):
            moved, sign = list(point), 1
            for (i, parity), side in zip(parities.items(), turned, strict=True):
                moved[i] = side * moved[i]
                sign *= side if parity < 0 else 1
            total += sign * self._cyclic(moved, output)
        return total / 2 ** len(parities)

    def _cyclic(self, point: Sequence[Expr], output: int) -> Expr:
        """The combination of outputs at the cosines of the periodic arguments."""
        there, weighted = list(point), [(sympy.S.One, output)]
        for i, period in self.shapes.periods.items():
            angle = 2 * sympy.pi * point[i] / period
            there[i] = sympy.cos(angle)
            parity = self.shapes.parities.get(i)
            if parity is not None:
                weighted = [(w * (1 if parity > 0 else sympy.sin(angle)), k) for w, k in weighted]
                continue
            up, down = (1 + sympy.sin(angle)) / 2, (1 - sympy.sin(angle)) / 2
            weighted = [pair for w, k in weighted for pair in ((w * up, k), (w * down, self._partner(k, i)))]
        return sympy.Add(*(w * self._raw(tuple(there), k) for w, k in weighted))

    def _partner(self, output: int, argument: int) -> int:
        if (output, argument) not in self._partners:
            self._partners[output, argument] = self.gate()
        return self._partners[output, argument]

    def _raw(self, point: tuple[Expr, ...], output: int) -> Expr:
        if point not in self.evaluations:
            self.evaluations.append(point)
        return raw(self.evaluations.index(point), output)
