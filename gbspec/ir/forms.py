"""The form in which an unknown with contracts is computed from its network, so that they hold for all weights.

A `Form` is an expression in the network's unscaled outputs; a `Layout` says which units of the network may depend on
which arguments, and in which direction. Both are decided by `gbspec.passes.contracts` and printed by the backends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import sympy

Expr: TypeAlias = sympy.Expr


class softplus(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy is untyped; its functions are named so
    """`log(1 + exp(x))`, computed without overflow."""

    is_real = True
    is_positive = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """The logistic function."""
        return logistic(self.args[0])

    def _eval_evalf(self, prec: int) -> Expr:
        return sympy.log(1 + sympy.exp(self.args[0]))._eval_evalf(prec)


class logistic(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy is untyped; its functions are named so
    """`1/(1 + exp(-x))`, computed without overflow."""

    is_real = True
    is_positive = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """`p (1 - p)`."""
        return logistic(self.args[0]) * (1 - logistic(self.args[0]))

    def _eval_evalf(self, prec: int) -> Expr:
        return (1 / (1 + sympy.exp(-self.args[0])))._eval_evalf(prec)


def raw(evaluation: int, output: int) -> sympy.Symbol:
    """Output `output` of the network, before its center and scale, at the arguments of an evaluation of the form."""
    return sympy.Symbol(f"raw {evaluation} {output}", real=True)


def center(output: int) -> sympy.Symbol:
    """The center of an output, a number kept with the weights."""
    return sympy.Symbol(f"center {output}", real=True)


def scale(output: int) -> sympy.Symbol:
    """The scale of an output, a positive number kept with the weights."""
    return sympy.Symbol(f"scale {output}", real=True)


def input_scale(argument: int) -> sympy.Symbol:
    """The scale of an argument, a positive number kept with the weights."""
    return sympy.Symbol(f"input_scale {argument}", real=True)


def described(text: str) -> tuple[str, tuple[int, ...]] | None:
    """The meaning of a symbol's name: ("raw", (evaluation, output)), ("scale", (output,)), ...; None for others."""
    word, *numbers = text.split(" ")
    if not numbers or word not in ("raw", "center", "scale", "input_scale"):
        return None
    return word, tuple(int(number) for number in numbers)


Scope = Literal["everywhere", "ranges"]


@dataclass(frozen=True)
class Form:
    """The value of an unknown: `value` in raw outputs, centers, scales, the formal arguments and constants.

    `evaluations`: the arguments at which the network is evaluated, as expressions in the formals; the first are usually
    the formals themselves. `scope`: whether the contracts hold for all real arguments or only within the ranges
    of `within`. `notes`: other decisions, in words (a correction kept positive, for instance).
    """

    evaluations: tuple[tuple[Expr, ...], ...]
    value: Expr
    scope: Scope = "everywhere"
    within: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


Shape = Literal["free", "convex", "concave", "saturating"]
"""The activation of a unit: the network's own, or a monotone one that is convex, concave or saturating."""


@dataclass(frozen=True)
class Block:
    """Units of a hidden layer with the same kind and activation.

    `kind` has one character per argument, for how the units may depend on it: `+` not decreasing, `-` not increasing,
    `x` convex (`p` and not decreasing, `q` and not increasing), `c` concave (`r`, `s`), `*` freely, `0` not at all.
    """

    kind: str
    shape: Shape
    count: int


@dataclass(frozen=True)
class Layout:
    """The directions of a network: its hidden layers as blocks (free ones first, saturating last), and its outputs.

    `outputs` holds the kind of each output, of the unknowns first, then of the extra outputs (`gates`).
    """

    hidden: tuple[tuple[Block, ...], ...]
    outputs: tuple[str, ...]
    gates: int = 0

    def plain(self) -> tuple[tuple[tuple[tuple[str, Shape, int], ...], ...], tuple[str, ...]]:
        """The layout as nested tuples of strings and numbers, for the generated module's text."""
        return tuple(tuple((b.kind, b.shape, b.count) for b in layer) for layer in self.hidden), self.outputs
