"""Functions that satisfy requirements for all weights: expressions in a network's raw outputs.

A raw output x is a multilayer perceptron without its last center c and scale s; if directions are required, it is
monotone by the signs of its weights (`gbspec.passes.layouts`). On it are built, in this order:

- *bounds*: `L + w softplus(s x/w + a)` with `softplus(a) = 1` and `w = max(c - L, 0.3 s)`: initially c, with
  slope 0.63 s and not saturated. Two bounds: `L + W logistic(...)`, initially with slope s.
- *zeros*: a difference `x(v) - x(zero)` of a function of one argument; or a factor that vanishes there:
  `d/sqrt(d^2 + l^2)`, its size, or its square, d the distance and l the argument's scale; or, if these would
  violate directions, a generalised Monod factor `d/(d + K)` whose half-saturation `K = l (2.02 - 2 logistic(g))`, g an
  extra output of the same directions, falls where the value rises.
- *bounds around a zero*: an increasing map that maps 0 to 0.

`docs/contracts.md` has the proofs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy

from gbspec.ir import Expr, Network, Unknown, center, input_scale, logistic, scale, softplus
from gbspec.passes.cores import Cores
from gbspec.passes.layouts import kind_of
from gbspec.passes.monotone import monotone
from gbspec.passes.requirements import Link, Wanted, Zero
from gbspec.passes.shapes import Refused, shown
from gbspec.passes.signs import Prover

START = sympy.Float(0.541324854612918)
"""The argument at which softplus is 1."""

LEAST = sympy.Float(0.3)
"""The initial bounded value has at least this many scales distance from its bound, so that it can change."""


@dataclass(frozen=True)
class Construction:
    """`value` in the raw outputs of `evaluations` (arguments of each); `kind` is the layout's kind of its outputs."""

    value: Expr
    kind: str
    evaluations: tuple[tuple[Expr, ...], ...]
    gates: int = 0
    smooth: tuple[int, ...] = ()
    extra: tuple[int, ...] = ()


class Builder:
    """Builds the function of one output.

    `prover` proves within the scope of the guarantee; `ranges` knows the arguments' ranges, which may choose among
    constructions that all hold. `first_gate` is the number of the first extra output that may be used.
    """

    def __init__(self, unknown: Unknown, network: Network, prover: Prover, ranges: Prover, first_gate: int) -> None:
        self.unknown, self.network, self.prover, self.ranges = unknown, network, prover, ranges
        self.formals = tuple(argument.symbol for argument in network.arguments)
        self.cores = Cores(self.formals, first_gate)
        self.first_gate = first_gate
        self.c, self.s = center(unknown.output), scale(unknown.output)

    @property
    def x(self) -> Expr:
        """The raw output, with the asked symmetries."""
        return self.cores.at(self.formals, self.unknown.output)

    # ---------------------------------------------------------------- entry points
    def correction(self, demands: Wanted) -> Construction:
        """A function without a link that satisfies the requirements."""
        return self.finished(self.value_of(demands), demands)

    def value_of(self, demands: Wanted) -> Expr:
        """The value of such a function."""
        return self.with_zeros(demands) if demands.zeros else self.bounded(demands, self.x, self.c, self.s)

    def linked(self, demands: Wanted, bounds: Wanted, link: Link) -> Construction:
        """The postulate corrected on the scale of a link; `demands` are the directions required of it."""
        lower, upper = bounds.lower, bounds.upper
        if lower is not None and upper is not None:
            value = self._odds_link(lower, upper, link)
        elif link.product:
            gain = self._positive(self.x if lower is not None else -self.x, sympy.S.One, self.s)
            bound = lower if lower is not None else upper
            value = bound + (link.base - bound) * gain
        elif lower is not None:
            value = lower + self._softplus_link((link.base - lower) / self.s, link.factor * self.x)
        else:
            value = upper - self._softplus_link((upper - link.base) / self.s, -link.factor * self.x)
        return self.finished(value, demands)

    def finished(self, value: Expr, demands: Wanted) -> Construction:
        """The construction with this value."""
        up, bend = demands.directions, demands.shapes.curvatures
        if self.network.spline:  # the arguments enter by the basis alone
            cores = self.cores
            constant = "0" * len(self.formals)
            return Construction(value, constant, tuple(cores.evaluations), cores.gates, cores.smooth, cores.extra)
        kind = "".join(kind_of(up.get(i, 0), bend.get(i, 0)) for i in range(len(self.formals)))
        return Construction(value, kind, tuple(self.cores.evaluations), self.cores.gates)

    # ---------------------------------------------------------------- bounds
    def bounded(self, demands: Wanted, x: Expr, start: Expr, size: Expr) -> Expr:
        """A value within the bounds that is `start` (inside them) at x = 0, with slope about `size` there."""
        lower, upper = demands.lower, demands.upper
        if lower is None and upper is None:
            return start + size * x
        self._check_moving(demands)
        moving = self.moves(lower) or self.moves(upper)
        if lower is not None and upper is not None:
            width = upper - lower
            if moving:
                return lower + width * logistic(x)
            p = sympy.Max(sympy.Min((start - lower) / width, sympy.Float(0.9)), sympy.Float(0.1))
            gain = sympy.Min(size / width, sympy.Float(0.5)) / (p * (1 - p))
            return lower + width * logistic(gain * x + sympy.log(p / (1 - p)))
        if lower is not None:
            return lower + (size * softplus(x + START) if moving else self._positive(x, start - lower, size))
        return upper - (size * softplus(START - x) if moving else self._positive(-x, upper - start, size))

    def _positive(self, x: Expr, start: Expr, size: Expr) -> Expr:
        """A positive value that is `start` (at least `LEAST` sizes) at x = 0, with slope 0.63 `size` there."""
        width = sympy.Max(start, LEAST * size)
        return width * softplus(size / width * x + START)

    def moves(self, bound: Expr | None) -> bool:
        """Whether a bound depends on arguments."""
        return bound is not None and bool(bound.free_symbols & set(self.formals))

    def _check_moving(self, demands: Wanted) -> None:
        """Raises `Refused` if a bound that depends on arguments does not have the required directions."""
        for i, direction in demands.directions.items():
            for kind, bound in (("lower", demands.lower), ("upper", demands.upper)):
                if bound is None or self.formals[i] not in bound.free_symbols:
                    continue
                if not monotone(self.prover, bound, self.formals[i], direction):
                    word = "increasing" if direction > 0 else "decreasing"
                    contracts = [c for c in self.unknown.contracts if c.kind in (kind, word)]
                    raise Refused(
                        "GB607",
                        f"`{self.unknown.name}` must be {word} in `{self.formals[i].name}`, but its bound"
                        f" `{shown(bound)}` is not proved to be {word}",
                        contracts,
                        "use a constant bound, or one with the same direction",
                    )

    # ---------------------------------------------------------------- zeros
    def with_zeros(self, demands: Wanted) -> Expr:
        """A value with zeros, and bounds around 0."""
        sign = self.sign(demands)
        gated = [zero for zero in demands.zeros if zero.argument in demands.directions]
        plain = [zero for zero in demands.zeros if zero.argument not in demands.directions]
        self._check_zeros(demands, gated)
        sign = self._sign_of_range(demands, gated) if sign is None else sign
        needs_sign = sign is not None or bool(demands.directions)
        factor = sympy.Mul(*(self.factor(zero, needs_sign) for zero in plain))
        if not gated:
            value = factor * self.core(sign)
        elif sign is not None:
            value = factor * self._one_sided(gated, demands, sign)
        elif len(gated) > 1:
            raise Refused(
                "GB607",
                f"`{self.unknown.name}` with zeros in several arguments, increasing or decreasing in each, has a"
                " construction only if its sign is known",
                [zero.contract for zero in gated],
                "add `>= 0` or `<= 0`, or give the arguments ranges that end at the zeros",
            )
        elif len(self.formals) == 1:
            value = factor * self.difference(gated[0])
        else:
            value = factor * self._two_sided(gated[0], demands)
        return self.around_zero(value, demands, sign)

    def core(self, sign: int | None) -> Expr:
        """A value of the sign, or of both signs."""
        if sign is None:
            return self.c + self.s * self.x
        return sign * self._positive(sign * self.x, sign * self.c, self.s)

    def distance(self, zero: Zero) -> Expr:
        """How far the argument is above its zero."""
        return self.formals[zero.argument] - zero.value

    def factor(self, zero: Zero, needs_sign: bool) -> Expr:
        """A factor that vanishes at the zero and saturates at 1; never negative if `needs_sign`.

        It is then 0 beyond a zero at the end of the argument's range: if it were positive there, a depleted substance
        would still be consumed.
        """
        d, size = self.distance(zero), input_scale(zero.argument)
        root = sympy.sqrt(d**2 + size**2)
        special = self.symmetric_factor(zero)
        if special is not None:
            return special
        if not needs_sign:
            return d / root
        if self.formals[zero.argument] not in self.ranges.box:
            return sympy.Abs(d) / root
        for side in (1, -1):
            if self.ranges.nonnegative(side * d):
                return _beyond(side * d) / root
        return d**2 / (d**2 + size**2)

    def symmetric_factor(self, zero: Zero) -> Expr | None:
        """A factor that is 0 at the zero and never negative, even or periodic as asked; None for other arguments."""
        v, e = self.formals[zero.argument], zero.value
        period = self.cores.shapes.periods.get(zero.argument)
        even = zero.argument in self.cores.shapes.parities
        if period is not None:
            value = sympy.sin(sympy.pi * (v - e) / period) ** 2
            return value * sympy.sin(sympy.pi * (v + e) / period) ** 2 if even and e != 0 else value
        if not even:
            return None
        size = input_scale(zero.argument) ** 2
        return v**2 / (v**2 + size) if e == 0 else (v**2 - e**2) ** 2 / ((v**2 - e**2) ** 2 + size**2)

    def sign(self, demands: Wanted) -> int | None:
        """1 or -1 if the bounds at the zeros allow one sign only, None if they allow both or there are none."""
        lower, upper = demands.lower, demands.upper
        for bound, side in ((lower, 1), (upper, -1)):
            if bound is None:
                continue
            outside = self.prover.positive(side * bound)
            if outside:
                raise self._contradiction("a bound that excludes 0", demands)
            if not self.prover.zero(bound) and not self.prover.positive(-side * bound):
                raise Refused(
                    "GB607",
                    f"the bound `{shown(bound)}` is not proved to be 0 or to allow 0 where"
                    f" `{self.unknown.name}` has its zero",
                    [c for c in self.unknown.contracts if c.kind in ("lower", "upper")],
                    "use a number as bound, or bound the constants in it: `learn k > 0`",
                )
        signs = [side for bound, side in ((lower, 1), (upper, -1)) if bound is not None and self.prover.zero(bound)]
        if len(signs) == 2:
            raise self._contradiction("bounds that leave only 0", demands)
        return signs[0] if signs else None

    def _contradiction(self, what: str, demands: Wanted) -> Refused:
        contracts = [z.contract for z in demands.zeros]
        contracts += [c for c in self.unknown.contracts if c.kind in ("lower", "upper")]
        return Refused("GB603", f"`{self.unknown.name}` has a zero and {what}", contracts, "delete one of them")

    def _check_zeros(self, demands: Wanted, gated: Sequence[Zero]) -> None:
        for zero in demands.zeros:
            moving = {self.formals[i] for i in demands.directions} & zero.value.free_symbols
            if moving:
                raise Refused(
                    "GB607",
                    f"a zero at `{shown(zero.value)}`, which moves with `{min(s.name for s in moving)}`, in which"
                    f" `{self.unknown.name}` must be monotone, has no construction",
                    [zero.contract],
                    "use a constant as the place of the zero",
                )
        seen: dict[int, Zero] = {}
        for zero in gated:
            first = seen.setdefault(zero.argument, zero)
            if first is not zero:
                raise Refused(
                    "GB603",
                    f"`{self.unknown.name}` has two zeros in `{self.formals[zero.argument].name}`, in which it is"
                    " monotone, so it would be 0 between them",
                    [zero.contract, first.contract],
                    "delete one of them",
                )

    def _sign_of_range(self, demands: Wanted, gated: Sequence[Zero]) -> int | None:
        """The sign implied by directions and ranges, for instance positive if increasing from a zero at the low end."""
        signs = set()
        for zero in gated:
            d = self.distance(zero) * demands.directions[zero.argument]
            if self.formals[zero.argument] not in self.ranges.box:
                return None
            signs.add(1 if self.ranges.nonnegative(d) else -1 if self.ranges.nonnegative(-d) else None)
        return signs.pop() if len(signs) == 1 else None

    # ---------------------------------------------------------------- zeros with directions
    def _half(self, zero: Zero, side: Expr) -> Expr:
        """A positive half-saturation from an extra output; it falls (side 1) or rises (-1) as the value rises."""
        gate = self.cores.at(self.formals, self.cores.gate())
        return input_scale(zero.argument) * (sympy.Float(2.02) - 2 * logistic(side * gate))

    def _one_sided(self, gated: Sequence[Zero], demands: Wanted, sign: int) -> Expr:
        """A value of one sign whose magnitude rises away from each zero on the allowed side, and is 0 on the other."""
        value = self.core(sign)
        for zero in gated:
            d = _beyond(sign * demands.directions[zero.argument] * self.distance(zero))
            if self._only_zero(zero, sign * demands.directions[zero.argument]):
                raise Refused(
                    "GB603",
                    f"the contracts leave `{self.unknown.name}` only the value 0 in the range of"
                    f" `{self.formals[zero.argument].name}`",
                    [zero.contract, *(c for c in self.unknown.contracts if c.argument == zero.contract.argument)],
                    "reverse the direction, or move the zero to the other end of the range",
                )
            value *= d / (d + self._half(zero, sympy.Integer(sign)))
        return value

    def _only_zero(self, zero: Zero, side: int) -> bool:
        known = self.formals[zero.argument] in self.ranges.box
        return known and self.ranges.nonnegative(-side * self.distance(zero))

    def difference(self, zero: Zero) -> Expr:
        """x - x(at the zero), for a single argument: then the second evaluation is a single point, not a batch."""
        there = tuple(zero.value if i == zero.argument else f for i, f in enumerate(self.formals))
        return self.s * (self.x - self.cores.at(there, self.unknown.output))

    def _two_sided(self, zero: Zero, demands: Wanted) -> Expr:
        """A positive rising part on one side of the zero, minus its mirror image on the other."""
        d = demands.directions[zero.argument] * self.distance(zero)
        side = sympy.sign(d)
        return self.s * d * softplus(side * self.x + START) / (sympy.Abs(d) + self._half(zero, side))

    def around_zero(self, value: Expr, demands: Wanted, sign: int | None) -> Expr:
        """The value mapped into bounds around 0 by an increasing map with 0 -> 0 and slope 1 there."""
        lower = None if demands.lower is None or self.prover.zero(demands.lower) else -demands.lower
        upper = None if demands.upper is None or self.prover.zero(demands.upper) else demands.upper
        if (lower is not None or upper is not None) and demands.directions:
            moving = [b for b in (lower, upper) if self.moves(b)]
            if moving:
                contracts = [c for c in self.unknown.contracts if c.kind in ("lower", "upper")]
                raise Refused(
                    "GB607",
                    f"the bound `{shown(moving[0])}` depends on an argument, which together with a zero and a direction"
                    " has no construction",
                    contracts,
                    "use a constant bound",
                )
        if sign is not None:
            bound = upper if sign > 0 else lower
            return value if bound is None else bound * sympy.tanh(value / bound)
        if lower is not None and upper is not None:
            t = sympy.tanh(value * (1 / lower + 1 / upper) / 2)
            return 2 * t / ((1 + t) / upper + (1 - t) / lower)
        if upper is not None:
            return upper * (1 - _algebraic(-2 * value / upper))
        return value if lower is None else lower * (_algebraic(2 * value / lower) - 1)

    # ---------------------------------------------------------------- links
    def _softplus_link(self, start: Expr, x: Expr) -> Expr:
        """`s softplus(softplus^-1(start) + x)`; `start` is in units of the scale, at least 0.05."""
        r = sympy.Max(start, sympy.Float(0.05))
        return self.s * softplus(r + sympy.log(1 - sympy.exp(-r)) + x)

    def _odds_link(self, lower: Expr, upper: Expr, link: Link) -> Expr:
        """Between bounds: the odds of the postulate's place between them, times exp(z)."""
        width = upper - lower
        if link.product:
            share = sympy.Max(sympy.Min((link.base - lower) / width, 1), 0)
            z = self.s * self.x
        else:
            share = sympy.Max(sympy.Min((link.base - lower) / width, sympy.Float(0.98)), sympy.Float(0.02))
            z = 4 * link.factor * self.s * self.x / width
        limited = sympy.Max(sympy.Min(z, 300), -300)
        return lower + width * share / (share + (1 - share) * sympy.exp(-limited))


def _beyond(d: Expr) -> Expr:
    """d where it is not negative, else 0; its derivative at 0 is 1, the one from the right."""
    return sympy.Piecewise((d, d >= 0), (sympy.S.Zero, True))


def _algebraic(x: Expr) -> Expr:
    """`(x + sqrt(x^2 + 4))/2`, without cancellation: positive, increasing, exactly 1 at 0 with slope 1/2."""
    return sympy.Max(x, 0) + 2 / (sympy.Abs(x) + sympy.sqrt(x**2 + 4))
