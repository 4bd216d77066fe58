"""The requirements of an unknown's contracts on its correction `nn`, given the postulate that contains `nn`.

Without a postulate the requirements on `nn` are those on the unknown. With one, either a simple requirement on `nn`
(none, a sign, directions, zeros) is proved to be sufficient, or the bounds are guaranteed by a link: the postulate's
value is mapped to an unbounded scale, corrected there, and mapped back, as in a generalised linear model.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import sympy

from gbspec.ir import NN, Contract, Expr, Network, Unknown
from gbspec.passes.intervals import REAL, Interval
from gbspec.passes.monotone import monotone
from gbspec.passes.shapes import SIGNS, WORDS, Refused, Shapes, of_correction, shapes, shown
from gbspec.passes.signs import Prover

NONNEGATIVE = Interval(0.0, REAL.high, False, True)


@dataclass(frozen=True)
class Zero:
    """The value vanishes where argument number `argument` is `value`."""

    argument: int
    value: Expr
    contract: Contract


@dataclass(frozen=True)
class Value(Zero):
    """The function is `to` where argument number `argument` is `value`."""

    to: Expr = sympy.S.Zero


@dataclass(frozen=True)
class Wanted:
    """The requirements on one function: bounds, zeros, values at places, and its shape in each argument."""

    lower: Expr | None = None
    upper: Expr | None = None
    zeros: tuple[Zero, ...] = ()
    shapes: Shapes = field(default_factory=Shapes)
    values: tuple[Value, ...] = ()

    @property
    def directions(self) -> dict[int, int]:
        """The directions (1 or -1) by index of argument."""
        return self.shapes.directions

    @property
    def bounded(self) -> bool:
        """Whether there is a bound."""
        return self.lower is not None or self.upper is not None


@dataclass(frozen=True)
class Link:
    """Bounds guaranteed by a link: `base` is the postulate without `nn`; `product`: `nn` is a factor, not a term."""

    base: Expr
    product: bool
    factor: Expr


@dataclass(frozen=True)
class Requirements:
    """Requirements on `nn` and the link if bounds need one; `notes` describes the decisions."""

    correction: Wanted
    link: Link | None = None
    notes: tuple[str, ...] = ()


def wanted(unknown: Unknown, network: Network, prover: Prover) -> Wanted:
    """The contracts of an unknown as requirements on its value; bounds of the same kind are joined.

    Raises:
        Refused: GB603 if two contracts name opposite directions, or shapes that only constants or lines have.
    """
    names = [argument.name for argument in network.arguments]
    lower, upper, zeros, values = [], [], [], []
    for contract in unknown.contracts:
        at = names.index(contract.argument) if contract.argument is not None else -1
        match contract.kind:
            case "lower":
                lower.append(contract.value)
            case "upper":
                upper.append(contract.value)
            case "zero":
                zeros.append(Zero(at, contract.value, contract))
            case "equals" if contract.to is not None:
                values.append(Value(at, contract.value, contract, contract.to))
    asked = shapes(unknown, network, prover)
    return Wanted(_joined(sympy.Max, lower), _joined(sympy.Min, upper), tuple(zeros), asked, tuple(values))


def _joined(extremum: type[Expr], values: Iterable[Expr]) -> Expr | None:
    distinct = list(dict.fromkeys(values))
    if not distinct:
        return None
    return distinct[0] if len(distinct) == 1 else extremum(*distinct)


def requirements(unknown: Unknown, network: Network, value: Wanted, prover: Prover) -> Requirements:
    """The requirements on `nn` that imply those on the unknown (`value`).

    Raises:
        Refused: GB605 if no requirement is proved to be sufficient.
    """
    if unknown.postulate == NN:
        return Requirements(value)
    return _Translation(unknown, network, value, prover).run()


def _way(prover: Prover, expression: Expr, variable: sympy.Symbol) -> int | None:
    """1 if it is proved to increase with the variable, -1 if to decrease, 0 if neither at all, None if not proved."""
    slope = prover.slope(expression, variable)
    sign = None if slope is None else prover.sign(slope)
    if sign is not None:
        return sign
    return next((way for way in (1, -1) if monotone(prover, expression, variable, way)), None)


class _Translation:
    def __init__(self, unknown: Unknown, network: Network, value: Wanted, prover: Prover) -> None:
        self.unknown, self.network, self.value, self.prover = unknown, network, value, prover
        self.postulate = unknown.postulate
        self.symbols = [argument.symbol for argument in network.arguments]

    def run(self) -> Requirements:
        for sign in (None, 1) if self.unknown.neutral > 0 else (None,):
            domain = self.prover.with_box({NN: REAL if sign is None else NONNEGATIVE})
            if not self._bounds_hold(domain):
                continue
            try:
                directions = self._directions(domain)
            except Refused:
                if sign is None and self.unknown.neutral > 0:
                    continue
                raise
            lower = None if sign is None else sympy.S.Zero
            notes = () if sign is None else ("`nn` is kept positive",)
            beyond = of_correction(self.unknown, self.symbols, self.value.shapes, domain)
            asked = replace(beyond, directions=directions)
            self._possible(asked)
            return Requirements(Wanted(lower, None, self._zeros(), asked), None, notes)
        if self.value.shapes.beyond or self.value.values:
            raise Refused(
                "GB607",
                f"the bounds of `{self.unknown.name}` do not follow from `{shown(self.postulate)}` by itself, and"
                " together with a curvature, a symmetry, a period or a value they have no construction",
                [c for c in self.unknown.contracts if c.kind in ("lower", "upper")],
                self._ranges_help() or "choose a postulate that keeps the bounds, such as `f*exp(nn)`",
            )
        if not self.value.bounded:
            self._directions(self.prover.with_box({NN: NONNEGATIVE if self.unknown.neutral > 0 else REAL}))
        return self._linked()

    def _possible(self, asked: Shapes) -> None:
        """Refuses shapes of `nn` in one argument that only constants, or lines, have: the mean of the values on both
        sides, which is even, does not increase where each of these does."""
        for i, parity in asked.parities.items():
            group, words = ("directions", "constants") if parity > 0 else ("curvatures", "straight lines")
            way = getattr(asked, group).get(i)
            if way is None:
                continue
            name = self.symbols[i].name
            kinds = (*WORDS[group], *WORDS["parities"])
            pair = [c for c in self.unknown.contracts if c.argument == name and c.kind in kinds]
            both = f"{'even' if parity > 0 else 'odd'} and {next(k for k in WORDS[group] if SIGNS[k] == way)}"
            raise Refused(
                "GB605",
                f"{' and '.join(f'`{c.kind} in {name}`' for c in pair)} cannot be kept together by the postulate"
                f" `{shown(self.postulate)}`: for both `nn` would have to be {both}, which only {words} are",
                pair,
                f"leave out one of them, or the postulate, or the argument `{name}` of the network",
            )

    def _bounds_hold(self, prover: Prover) -> bool:
        """Whether the postulate satisfies the bounds for every `nn` in its domain."""
        lower, upper = self.value.lower, self.value.upper
        return (lower is None or prover.nonnegative(self.postulate - lower)) and (
            upper is None or prover.nonnegative(upper - self.postulate)
        )

    # ---------------------------------------------------------------- directions
    def _directions(self, prover: Prover) -> dict[int, int]:
        """The directions that `nn` must have; those of the rest of the postulate are proved."""
        if not self.value.directions:
            return {}
        sign = _way(prover, self.postulate, NN)
        out = {}
        for i, direction in self.value.directions.items():
            contract = self._contract_of(i)
            self._own_direction(self.postulate, i, direction, contract, prover)
            if sign is None or sign == 0:
                raise Refused(
                    "GB605",
                    f"`{contract.kind} in {self.symbols[i].name}` cannot be kept: it is not clear in which direction"
                    f" `{shown(self.postulate)}` depends on `nn`",
                    (contract,),
                    self._ranges_help() or "use `nn` as in `f + nn`, `f*nn` with f of one sign, or `exp(nn)`",
                )
            out[i] = direction * sign
        return out

    def _own_direction(self, expression: Expr, i: int, direction: int, contract: Contract, prover: Prover) -> None:
        if not monotone(prover, expression, self.symbols[i], direction):
            name = self.symbols[i].name
            jumps = prover.slope(expression, self.symbols[i]) is None
            how = "jumps (`if`, `sign`, `floor` or `mod`), so it is not" if jumps else "is not proved to be"
            raise Refused(
                "GB605",
                f"`{contract.kind} in {name}` cannot be kept: the postulate `{shown(self.postulate)}` {how}"
                f" {contract.kind} in `{name}` by itself",
                (contract,),
                self._ranges_help(name) or "choose another postulate, or leave out the contract",
            )

    def _contract_of(self, argument: int) -> Contract:
        name = self.network.arguments[argument].name
        return next(c for c in self.unknown.contracts if c.argument == name and c.kind in ("increasing", "decreasing"))

    def _ranges_help(self, first: str | None = None) -> str:
        """Ranges that would help the proof: of arguments and constants that have none."""
        used = self.postulate.free_symbols - {NN}
        names = sorted((s.name for s in used if self.prover.box.get(s, REAL) == REAL), key=lambda n: (n != first, n))
        if not names:
            return ""
        return f"a range may be what the proof lacks: `{names[0]} in [0, 10]`" + (
            f" (also of {', '.join(f'`{n}`' for n in names[1:])})" if names[1:] else ""
        )

    # ---------------------------------------------------------------- zeros
    def _zeros(self) -> tuple[Zero, ...]:
        """The zeros that `nn` must have; none where the postulate vanishes for every `nn`."""
        needed = []
        for zero in (*self.value.zeros, *self.value.values):
            at = self.postulate.xreplace({self.symbols[zero.argument]: zero.value})
            to = zero.to if isinstance(zero, Value) else sympy.S.Zero
            if self.prover.zero(at - to):
                continue
            if not self.prover.zero((at - to).xreplace({NN: sympy.S.Zero})):
                name = self.symbols[zero.argument].name
                what = f"equals {shown(to)}" if isinstance(zero, Value) else "zero"
                raise Refused(
                    "GB605",
                    f"`{what} at {name} = {shown(zero.value)}` cannot be kept: there the postulate is `{shown(at)}`,"
                    f" which is not {shown(to)} for `nn = 0`",
                    (zero.contract,),
                    f"choose a postulate that {'vanishes' if to == 0 else f'is {shown(to)}'} at"
                    f" `{name} = {shown(zero.value)}`",
                )
            needed.append(zero)
        return tuple(needed)

    # ---------------------------------------------------------------- links
    def _linked(self) -> Requirements:
        """The requirements with a link, for a postulate that is a sum or a product with `nn`."""
        bounds = [c for c in self.unknown.contracts if c.kind in ("lower", "upper")]
        factor = sympy.diff(self.postulate, NN)
        rest = self.postulate.xreplace({NN: sympy.S.Zero})
        if factor.has(NN) or rest.has(sympy.nan, sympy.zoo) or self.postulate.has(sympy.Piecewise):
            raise Refused(
                "GB605",
                f"the bounds cannot be kept: `{shown(self.postulate)}` violates them for some `nn`, and `nn` is neither"
                " a term nor a factor of it",
                bounds,
                "write the postulate as `f + nn` or `f*nn`, or leave the bound out",
            )
        product = rest == 0
        base = sympy.sympify(self.postulate.xreplace({NN: sympy.Float(self.unknown.neutral)}))
        if product:
            base = factor
        two_sided = self.value.lower is not None and self.value.upper is not None
        self._check_link(base, factor, product, two_sided, bounds)
        if product and two_sided:
            self._check_reach(base, bounds)
        sign = 1 if product else self.prover.sign(factor) or 1
        directions = {i: sign * direction for i, direction in self.value.directions.items()}
        note = "bounds are guaranteed by a link that starts at the postulate"
        return Requirements(Wanted(shapes=Shapes(directions)), Link(base, product, factor), (note,))

    def _check_reach(self, base: Expr, bounds: Sequence[Contract]) -> None:
        """Refuses a factor (which scales the odds between two bounds) if the postulate is beyond a bound."""
        for bound, side, where in (
            (self.value.upper, 1, "never less than the upper bound"),
            (self.value.lower, -1, "never more than the lower bound"),
        ):
            if bound is not None and self.prover.nonnegative(side * (base - bound)):
                raise Refused(
                    "GB605",
                    f"the bounds cannot be kept: `{shown(base)}` is {where} `{shown(bound)}`, so no factor `nn` brings"
                    " the value between them",
                    bounds,
                    "choose a postulate that lies between the bounds, or correct them",
                )

    def _check_link(self, base: Expr, factor: Expr, product: bool, two_sided: bool, bounds: Sequence[Contract]) -> None:
        lower, upper = self.value.lower, self.value.upper
        if not (self.prover.finite(base) and self.prover.finite(factor)):
            raise Refused(
                "GB605",
                f"the bounds cannot be kept: `{shown(self.postulate)}` is not proved to be a finite number everywhere",
                bounds,
                self._ranges_help() or "choose a postulate without poles",
            )
        for i, direction in self.value.directions.items():
            contract = self._contract_of(i)
            self._own_direction(base, i, direction, contract, self.prover)
            moving = [part for part in (lower, upper, None if product else factor) if part is not None]
            if any(self.symbols[i] in part.free_symbols for part in moving):
                raise Refused(
                    "GB607",
                    f"`{contract.kind} in {self.symbols[i].name}` together with a bound or a factor of `nn` that"
                    f" depends on `{self.symbols[i].name}` has no construction",
                    (contract, *bounds),
                    "use constant bounds",
                )
        if not product and self.prover.sign(factor) not in (1, -1):
            raise Refused(
                "GB605",
                f"the bounds cannot be kept: the sign of `{shown(factor)}` is not clear",
                bounds,
                self._ranges_help() or "multiply `nn` by an expression of one sign, or leave the bound out",
            )
        inside_lower = lower is None or self.prover.nonnegative(base - lower)
        inside_upper = upper is None or self.prover.nonnegative(upper - base)
        if product and not two_sided and not (inside_lower and inside_upper):
            raise Refused(
                "GB605",
                f"the bound cannot be kept: `{shown(base)}` is not proved to satisfy it, so a factor `nn` near 1"
                " may violate it",
                bounds,
                self._ranges_help() or "choose a postulate that keeps the bound by itself",
            )
        for zero in self.value.zeros:
            at = base.xreplace({self.symbols[zero.argument]: zero.value})
            kept = product and self.prover.zero(at) and inside_lower and inside_upper
            at_end = any(end is not None and self.prover.zero(end) for end in (lower, upper))
            if not (kept and at_end):
                raise Refused(
                    "GB607",
                    f"`zero at {self.symbols[zero.argument].name} = {shown(zero.value)}` together with this bound has"
                    f" no construction for the postulate `{shown(self.postulate)}`",
                    (zero.contract, *bounds),
                    "write the postulate as a product, `f*nn`, with an `f` that vanishes there and keeps the bounds",
                )
