"""Curvature, parity, periods and values of an unknown: what contracts ask, and what a postulate leaves to `nn`.

`gbspec.passes.cores` makes raw outputs even, odd or periodic; `gbspec.passes.bent` keeps curvature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import sympy

from gbspec.ir import NN, Contract, Expr, Network, Unknown, in_language
from gbspec.passes.monotone import monotone
from gbspec.passes.signs import Prover

SIGNS = {"increasing": 1, "decreasing": -1, "convex": 1, "concave": -1, "even": 1, "odd": -1}
WORDS = {"directions": ("increasing", "decreasing"), "curvatures": ("convex", "concave"), "parities": ("even", "odd")}
REASONS = {
    "directions": "increasing and decreasing in",
    "curvatures": "convex and concave in",
    "parities": "even and odd in",
}


class Refused(Exception):  # noqa: N818 - not an error: no guarantee is possible
    """A contract that cannot be guaranteed: the reason, its code and a remedy."""

    def __init__(self, code: str, message: str, contracts: Sequence[Contract], help: str = "") -> None:
        self.code, self.message, self.contracts, self.help = code, message, tuple(contracts), help
        super().__init__(message)


def shown(expression: Expr) -> str:
    """An expression in a message: as a `.gb` file would write it."""
    return in_language(expression)


@dataclass(frozen=True)
class Shapes:
    """Of each argument, by index: 1 or -1 for increasing or decreasing, convex or concave, even or odd; and its
    period."""

    directions: dict[int, int] = field(default_factory=dict)
    curvatures: dict[int, int] = field(default_factory=dict)
    parities: dict[int, int] = field(default_factory=dict)
    periods: dict[int, Expr] = field(default_factory=dict)

    @property
    def beyond(self) -> bool:
        """Whether there is more than directions."""
        return bool(self.curvatures or self.parities or self.periods)


def shapes(unknown: Unknown, network: Network, prover: Prover) -> Shapes:
    """The shapes that an unknown's contracts ask for.

    Raises:
        Refused: GB603 if two of them leave only constants or straight lines, GB609 if a period is not positive.
    """
    names = [argument.name for argument in network.arguments]
    found = Shapes()
    for name, i in {n: i for i, n in enumerate(names)}.items():
        own = [c for c in unknown.contracts if c.argument == name]
        for group, words in WORDS.items():
            asked = [c for c in own if c.kind in words]
            if len({c.kind for c in asked}) == 2:
                raise _together(unknown, name, asked, REASONS[group], group)
            if asked:
                getattr(found, group)[i] = SIGNS[asked[0].kind]
        for contract in own:
            if contract.kind == "period":
                _period(unknown, contract, found.periods.get(i), prover)
                found.periods[i] = cast(Expr, contract.value)
        _alone(unknown, name, own, found, i)
    return found


def _together(unknown: Unknown, name: str, contracts: Sequence[Contract], words: str, group: str) -> Refused:
    kinds = [next(c for c in contracts if c.kind == kind) for kind in dict.fromkeys(c.kind for c in contracts)]
    help = f"delete one of them; if it does not depend on `{name}`, leave the argument out"
    if group == "curvatures":
        help = f"delete one of them; a straight line is a postulate: `= a + b*{name}` with learnable constants"
    return Refused("GB603", f"`{unknown.name}` cannot be {words} `{name}`", kinds[::-1], help)


def _period(unknown: Unknown, contract: Contract, other: Expr | None, prover: Prover) -> None:
    value = cast(Expr, contract.value)
    if other is not None and other != value:
        raise Refused("GB603", f"`{unknown.name}` has two periods in `{contract.argument}`", [contract], "delete one")
    if not prover.positive(value):
        raise Refused(
            "GB609",
            f"the period `{shown(value)}` is not proved to be above 0",
            [contract],
            "use a positive number, or bound the constants in it: `learn T = 24 in [20, 28]`",
        )


def _alone(unknown: Unknown, name: str, own: Sequence[Contract], found: Shapes, i: int) -> None:
    """Raises `Refused` (GB603) where two shapes in one argument leave only constants, straight lines or 0."""
    for first, second, left in (
        ("periods", "directions", "constant functions"),
        ("periods", "curvatures", "constant functions"),
        ("even", "directions", "constant functions"),
        ("odd", "curvatures", "straight lines through 0"),
    ):
        one = i in found.periods if first == "periods" else found.parities.get(i) == SIGNS[first]
        if one and i in getattr(found, second):
            kinds = {*WORDS[second], "period" if first == "periods" else first}
            pair = [c for c in own if c.kind in kinds]
            word = " and ".join("periodic" if c.kind == "period" else c.kind for c in pair[:2])
            raise Refused(
                "GB603",
                f"in `{name}` only {left} are {word}",
                pair[::-1],
                f"delete one of them; an even function that rises with the size of `{name}` is `convex in {name}`"
                if first == "even"
                else "delete one of them",
            )


def mirrored(expression: Expr, variable: sympy.Symbol) -> Expr:
    """The expression at the opposite argument."""
    return expression.xreplace({variable: -variable})


def with_fractions(expression: Expr) -> Expr:
    """The expression with exact fractions in place of decimals: those that a file has written."""
    return expression.xreplace({n: sympy.Rational(str(n)) for n in expression.atoms(sympy.Float)})


def same(left: Expr, right: Expr) -> bool:
    """Whether two expressions are equal, identically, with exact fractions in place of decimals."""
    difference = sympy.expand(with_fractions(left) - with_fractions(right))
    return bool(difference == 0) or bool(sympy.expand(sympy.fraction(sympy.together(difference))[0]) == 0)


def symmetric(expression: Expr, formals: Sequence[sympy.Symbol], asked: Shapes) -> bool:
    """Whether it has the even arguments and the periods that are asked for, and depends on no odd argument."""
    for i, parity in asked.parities.items():
        known = formals[i] in expression.free_symbols
        if known and (parity < 0 or not same(mirrored(expression, formals[i]), expression)):
            return False
    return all(
        formals[i] not in expression.free_symbols
        or same(expression.xreplace({formals[i]: formals[i] + period}), expression)
        for i, period in asked.periods.items()
    )


def of_correction(unknown: Unknown, formals: Sequence[sympy.Symbol], asked: Shapes, prover: Prover) -> Shapes:
    """The curvatures, parities and periods that `nn` must have for those of the postulate.

    Raises:
        Refused: GB605 if none is proved to be sufficient.
    """
    parities = {i: _parity(unknown, formals[i], parity) for i, parity in asked.parities.items()}
    for i, period in asked.periods.items():
        shifted = unknown.postulate.xreplace({formals[i]: formals[i] + period})
        if not same(shifted, unknown.postulate):
            raise _unkept(unknown, "period", formals[i].name, "by itself it does not have this period")
    curvatures = {i: _curvature(unknown, formals[i], way, prover) for i, way in asked.curvatures.items()}
    return Shapes({}, curvatures, parities, dict(asked.periods))


def _parity(unknown: Unknown, variable: sympy.Symbol, parity: int) -> int:
    other = mirrored(unknown.postulate, variable)
    if same(other, parity * unknown.postulate):
        return 1
    if same(other.xreplace({NN: -NN}), parity * unknown.postulate):
        return -1
    word = "even" if parity > 0 else "odd"
    raise _unkept(unknown, word, variable.name, f"it is not {word} in `{variable.name}`, whether `nn` is even or odd")


def _curvature(unknown: Unknown, variable: sympy.Symbol, way: int, prover: Prover) -> int:
    """The curvature of `nn` in `a + b*nn`, with b of one sign and without the argument, and a of that curvature."""
    factor = sympy.diff(unknown.postulate, NN)
    rest = unknown.postulate.xreplace({NN: sympy.S.Zero})
    word = "convex" if way > 0 else "concave"
    sign = None if factor.has(NN) or variable in factor.free_symbols else prover.sign(factor)
    if sign not in (1, -1):
        reason = f"it is not a sum of a known function and `nn` times a factor of one sign without `{variable.name}`"
        raise _unkept(unknown, word, variable.name, reason)
    if variable in rest.free_symbols:
        slope = prover.slope(rest, variable)
        if slope is None or not monotone(prover, slope, variable, way):
            raise _unkept(unknown, word, variable.name, f"`{shown(rest)}` is not proved to be {word}")
    return way * int(sign)


def _unkept(unknown: Unknown, kind: str, name: str, reason: str) -> Refused:
    contracts = [c for c in unknown.contracts if c.kind == kind and c.argument == name]
    words = f"period in {name}" if kind == "period" else f"{kind} in {name}"
    return Refused(
        "GB605",
        f"`{words}` cannot be kept by the postulate `{shown(unknown.postulate)}`: {reason}",
        contracts,
        "choose another postulate, or leave out the contract",
    )
