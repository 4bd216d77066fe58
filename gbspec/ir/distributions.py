"""Distributions of constants between trajectories, and the noise of channels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import sympy

from gbspec.ir.noises import LEAST_COUNT, NoiseKind

Expr: TypeAlias = sympy.Expr

Spread = Literal["lognormal", "normal", "logitnormal", "standard"]

PREDICTION = sympy.Symbol("prediction of the channel", real=True)
"""The prediction in the expression of a noise; not a name that a model can declare."""


@dataclass(frozen=True)
class Level:
    """A further deviation, which all trajectories with the same value of the condition `column` share: `spread` is the
    name of a learnable, or among `Model.implied`; without it the spread is the number `fixed`."""

    column: str
    spread: str | None = None
    fixed: float = 1.0


@dataclass(frozen=True)
class Distribution:
    """How the values of a constant are distributed between trajectories.

    With a standard normal number e and the spread s: `lognormal` median*exp(s*e), `normal` median + s*e, `logitnormal`
    the value within the range whose logit is that of the median plus s*e, `standard` e itself (no median, no spread).
    `median` is the name of the median among `Model.implied`; `spread` that of a learnable, or among `Model.implied`;
    without it the spread is the number `fixed`. The deviations of `levels` are added to s*e; a constant that differs
    between groups alone has the spread 0 between trajectories.
    """

    kind: Spread
    median: str = ""
    spread: str | None = None
    fixed: float = 1.0
    levels: tuple[Level, ...] = ()

    @property
    def spreads(self) -> tuple[tuple[str | None, float], ...]:
        """The name of each spread (None: fixed) with its fixed number, that between trajectories first."""
        return (self.spread, self.fixed), *((level.spread, level.fixed) for level in self.levels)


@dataclass(frozen=True)
class Noise:
    """`normal(sd)` or `student(scale, df)` in the channel's unit, `lognormal(cv)`, `poisson` or `negative_binomial(k)`.

    If the scale is learned, `value` is its expression in learnables and PREDICTION, and `scale` not a number. Where the
    noise has a density of its own (`noises.py`) it always is: such a channel has a likelihood and no sum of squares;
    of counts `value` is the standard deviation. `shape` is the expression of the degrees of freedom of `student` and of
    the size of `negative_binomial`, in learnables.
    """

    kind: NoiseKind
    scale: float = field(hash=False)
    value: Expr | None = None
    shape: Expr | None = None

    def __eq__(self, other: object) -> bool:
        """NaN, the scale of a learned noise, differs from itself, and Python 3.13 compares field by field."""
        if not isinstance(other, Noise):
            return NotImplemented
        same = self.value is not None or self.scale == other.scale
        return same and (self.kind, self.value, self.shape) == (
            other.kind,
            other.value,
            other.shape,
        )


def deviation_of_counts(size: Expr | None) -> Expr:
    """The standard deviation by PREDICTION: of Poisson counts, or of negative binomial ones of this size."""
    mean = sympy.Max(PREDICTION, sympy.Float(LEAST_COUNT))
    return sympy.sqrt(mean if size is None else mean + mean**2 / size)
