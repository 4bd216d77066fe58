"""Functions that are convex or concave, even, odd or periodic in an argument for all weights.

On a raw output x with these properties (`gbspec.passes.cores`, and convex by the signs of the weights):

- *odd*: `s x`, times even factors for zeros in other arguments; between bounds -b and b: `b tanh(s x/b)`.
- *even, periodic*: as without, with factors for zeros that are even or periodic; without a sign the difference
  `x(v) - x(e)`.
- *convex*: `c + s x`; above a bound the rising convex map `L + w softplus(...)`; times factors of other arguments that
  are not negative. With a zero in the argument: `x(v) - x(e)`, above a lower bound by a rising convex map. A sign
  then follows from the direction and the range, or from evenness. Concave: the mirror image.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy

from gbspec.ir import Contract, Expr
from gbspec.passes.constructions import Builder, Construction
from gbspec.passes.requirements import Wanted, Zero
from gbspec.passes.shapes import Refused, Shapes, shown, symmetric
from gbspec.passes.splines import SplineCores

NO_CONSTRUCTION = "GB607"


class ShapedBuilder(Builder):
    """Builds the function of one output whose contracts may ask for curvatures and symmetries."""

    def shaped(self, demands: Wanted, offset: Expr) -> Construction:
        """A function without a link that satisfies the requirements, plus a known one.

        Raises:
            Refused: GB603 for contradictions, GB607 if no construction is known.
        """
        self.cores.shapes = demands.shapes
        self.c -= offset
        self._check_symmetry(demands)
        if any(parity < 0 for parity in demands.shapes.parities.values()):
            value = self._odd(demands)
        elif demands.shapes.curvatures:
            value = self._curved(demands)
        else:
            value = self._even(demands)
        return self.finished(offset + value, demands)

    def splined(self, shapes: Shapes) -> None:
        """Takes a spline in place of the network. Raises `Refused` for what it does not offer."""
        cores = SplineCores(self.unknown, self.network, self.formals, self.first_gate, self.ranges.box)
        cores.checked(self.unknown, shapes)
        cores.shapes = shapes
        self.cores = cores

    # ---------------------------------------------------------------- symmetries
    def _check_symmetry(self, demands: Wanted) -> None:
        """Raises `Refused` if a bound or the place of a zero lacks a symmetry that the value must have."""
        parts = [(bound, ("lower", "upper")) for bound in (demands.lower, demands.upper) if bound is not None]
        parts += [(zero.value, ("zero", "equals")) for zero in demands.zeros]
        for part, kinds in parts:
            if not symmetric(part, self.formals, demands.shapes):
                raise Refused(
                    NO_CONSTRUCTION,
                    f"`{shown(part)}` does not have the symmetry or period that `{self.unknown.name}` must have",
                    self._contracts(*kinds, "odd", "even", "period"),
                    "use a constant in its place",
                )

    def _contracts(self, *kinds: str) -> list[Contract]:
        return [c for c in self.unknown.contracts if c.kind in kinds]

    def _none(self, why: str, help: str, *kinds: str) -> Refused:
        return Refused(NO_CONSTRUCTION, f"{why} has no construction", self._contracts(*kinds), help)

    def _odd(self, demands: Wanted) -> Expr:
        odd = {i for i, parity in demands.shapes.parities.items() if parity < 0}
        names = ", ".join(f"`{self.formals[i].name}`" for i in sorted(odd))
        # Also of two arguments in which it is odd: it rises in v for u and for -u, and f(-u, v) = -f(u, v), only at 0.
        if any(odd - {i} for i in demands.directions) or demands.shapes.curvatures:
            what = f"`{self.unknown.name}`, odd in {names}, with a direction or a curvature in another argument"
            help = "write it as a product of an odd function and one of the other arguments"
            raise self._none(what, help, "odd", "increasing", "decreasing", "convex", "concave")
        zeros = []
        for zero in demands.zeros:
            if zero.argument not in odd:
                zeros.append(zero)
            elif not self.prover.zero(zero.value):
                what = f"a zero of `{self.unknown.name}` beside that at 0, which every odd function has,"
                raise self._none(what, "leave it out, or write it into a postulate", "odd", "zero", "equals")
        value = sympy.Mul(self.s * self.x, *(self.factor(zero, True) for zero in zeros))
        limit = self._limit(demands)
        return value if limit is None else limit * sympy.tanh(value / limit)

    def _limit(self, demands: Wanted) -> Expr | None:
        """The largest size within the bounds of an odd function."""
        sizes = [s for s in (None if demands.lower is None else -demands.lower, demands.upper) if s is not None]
        for size in sizes:
            if self.prover.nonnegative(-size):
                raise Refused(
                    "GB603",
                    f"an odd function has both signs, so that the bound leaves `{self.unknown.name}` only the value 0",
                    self._contracts("lower", "upper", "odd"),
                    "delete the bound, or `even` in place of `odd`",
                )
            if not self.prover.positive(size):
                what = f"the bound at distance `{shown(size)}` of an odd function, not proved to be above 0,"
                raise self._none(what, "use a number, or bound the constants in it", "lower", "upper", "odd")
        return None if not sizes else sizes[0] if len(set(sizes)) == 1 else sympy.Min(*sizes)

    def _even(self, demands: Wanted) -> Expr:
        """Also for periodic functions, and without any symmetry."""
        special = [zero for zero in demands.zeros if self.symmetric_factor(zero) is not None]
        if len(special) != 1 or demands.directions or self.sign(demands) is not None:
            return self.value_of(demands)
        factors = [self.factor(zero, True) for zero in demands.zeros if zero is not special[0]]
        return self.around_zero(sympy.Mul(self.difference(special[0]), *factors), demands, None)

    # ---------------------------------------------------------------- curvature
    def _curved(self, demands: Wanted) -> Expr:
        ways = set(demands.shapes.curvatures.values())
        if len(ways) > 1:
            what = f"`{self.unknown.name}`, convex in one argument and concave in another,"
            raise self._none(what, "write it as a sum or product of two unknown functions", "convex", "concave")
        way, bent = ways.pop(), set(demands.shapes.curvatures)
        inside = [zero for zero in demands.zeros if zero.argument in bent]
        outside = [zero for zero in demands.zeros if zero.argument not in bent]
        if any(zero.argument in demands.directions for zero in outside):
            what = "a curvature together with a zero and a direction in another argument"
            raise self._none(what, "write it as a product of two unknown functions", "zero", "equals", *KINDS)
        for part in (demands.lower, demands.upper, *(zero.value for zero in demands.zeros)):
            if part is not None and any(self.formals[i] in part.free_symbols for i in bent):
                what = f"`{shown(part)}`, which depends on an argument in which there is a curvature,"
                raise self._none(what, "use a constant in its place", "lower", "upper", "zero", "equals", *KINDS)
        if inside:
            return self._curved_from_zero(demands, way, inside, outside)
        self._check_sides(demands, way)
        if not outside:
            return self.bounded(demands, self.x, self.c, self.s)
        sign = self.sign(demands)
        if sign is None and demands.bounded:
            what = "a curvature together with a bound that is not 0 and a zero in another argument"
            raise self._none(what, "leave the bound out", "lower", "upper", "zero", "equals", *KINDS)
        return sympy.Mul(self.core(sign), *(self.factor(zero, True) for zero in outside))

    def _check_sides(self, demands: Wanted, way: int) -> None:
        """Raises `Refused` for a bound on the side to which the function bends."""
        word = "convex" if way > 0 else "concave"
        if (demands.upper if way > 0 else demands.lower) is not None:
            raise Refused(
                NO_CONSTRUCTION,
                f"a {word} function with {'an upper' if way > 0 else 'a lower'} bound has no construction: over all"
                " real numbers only constants have both",
                self._contracts("upper" if way > 0 else "lower", word),
                "leave the bound out; for a law that starts at 0 write `zero at` and a direction, from which the sign"
                " follows within the argument's range",
            )

    def _curved_from_zero(self, demands: Wanted, way: int, inside: Sequence[Zero], outside: Sequence[Zero]) -> Expr:
        zero, others = inside[0], {*demands.directions, *demands.shapes.curvatures} - {inside[0].argument}
        if len(inside) > 1 or others:
            what = "a curvature and a zero in one argument, with another zero there or a shape in another argument,"
            help = "write it as a product of two unknown functions, one for each argument"
            raise self._none(what, help, "zero", "equals", "increasing", "decreasing", *KINDS)
        value = sympy.Mul(self.difference(zero), *(self.factor(other, True) for other in outside))
        side = self._side(zero, demands, way)
        # Bounds on the side where the function is not, or to which it does not bend.
        lower = None if side > 0 and self._at_most_zero(demands.lower) else demands.lower
        above = None if demands.upper is None else -demands.upper
        upper = None if side < 0 and self._at_most_zero(above) else demands.upper
        self._check_sides(Wanted(None if way > 0 else lower, None if way < 0 else upper), way)
        bound = lower if way > 0 else upper
        if bound is not None and self.prover.zero(bound):
            what = f"a sign of `{self.unknown.name}` that does not follow from its direction and the range"
            help = "give the argument a range that ends at the zero, with a direction; or `even in` it"
            raise self._none(what, help, "lower", "upper", "zero", "equals", *KINDS)
        if bound is None:
            return value
        self.sign(Wanted(lower if way > 0 else None, upper if way < 0 else None, demands.zeros))
        if side == -way:
            return bound * sympy.tanh(value / bound)
        return self.around_zero(value, Wanted(lower if way > 0 else None, upper if way < 0 else None), None)

    def _at_most_zero(self, bound: Expr | None) -> bool:
        return bound is not None and self.prover.nonnegative(-bound)

    def _side(self, zero: Zero, demands: Wanted, way: int) -> int:
        """1 or -1 if the difference from the value at the zero is proved to be of that sign, else 0."""
        if zero.argument in demands.shapes.parities and self.prover.zero(zero.value):
            return way  # an even convex function is least at 0
        direction = demands.directions.get(zero.argument, 0)
        distance = self.distance(zero)
        for side in (1, -1):
            if direction and self.prover.nonnegative(side * direction * distance):
                return side
        return 0


KINDS = ("convex", "concave")
