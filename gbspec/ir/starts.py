"""Where states start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import sympy

from gbspec.diagnostics import Span

Expr: TypeAlias = sympy.Expr


@dataclass(frozen=True)
class Initial:
    """The initial value of a state.

    `expression`: known, `value` in constants, learnables, conditions and the symbols of other states (their initial
    values).
    `learned`: a trainable number for each trajectory. `measured`: the first measured value if the state itself is
    measured at the trajectory's first row, else learned (the default). `steady`: that of the steady state that is
    reached from `value`.
    """

    kind: Literal["expression", "learned", "measured", "steady"]
    value: Expr | None = None
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def known(self) -> bool:
        """Whether it follows from constants and conditions, so that nothing is measured or learned."""
        return self.kind in ("expression", "steady")


MEASURED = Initial("measured")
"""The default."""


@dataclass(frozen=True)
class Steady:
    """A start in a steady state: of the states `states`, while conditions and inputs have the values `held` (doses are
    off), with the totals of their starts by the linear `laws`: coefficients of these states.

    `after`: the values that states get then, in constants, conditions and the states there. `chosen`: 1 in trajectories
    that start so, 0 in others, which start at the declared values; None: all do."""

    states: tuple[int, ...]
    held: tuple[tuple[str, Expr], ...] = ()
    laws: tuple[tuple[Expr, ...], ...] = ()
    after: tuple[tuple[int, Expr], ...] = ()
    chosen: Expr | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
