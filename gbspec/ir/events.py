"""Events of a Model: what happens at a time, or when a condition becomes true; and where right-hand sides switch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import sympy

from gbspec.diagnostics import Span

Expr: TypeAlias = sympy.Expr


@dataclass(frozen=True)
class Timing:
    """The times of an event: `at` (None: the start of the trajectory), then `every` so often, up to `until`."""

    at: Expr | None = None
    every: Expr | None = None
    until: Expr | None = None


@dataclass(frozen=True)
class Event:
    """Sets states: those in `values`, each to an expression of the values before.

    It happens when `guard` becomes positive or zero (`condition` says the same as a relation, for display), or at the
    times of `timing`; one of the two is None. `armed`: also at the start, if the condition is true there. `rank` is a
    priority that is computed when the event can happen; None if it is the number `priority`.
    """

    name: str
    values: tuple[tuple[str, Expr], ...] = ()
    guard: Expr | None = None
    condition: sympy.Basic | None = None
    timing: Timing | None = None
    priority: float = 0.0
    rank: Expr | None = None
    armed: bool = False
    description: str = field(default="", kw_only=True)
    span: Span | None = field(default=None, kw_only=True, compare=False, repr=False)


@dataclass(frozen=True)
class Switch:
    """Where right-hand sides switch: where `guard` changes its sign (`gbspec.passes.switching` finds these places).

    They hold `guard + symbol > 0` in place of `guard > 0`. The symbol is 0 where nothing is held, else `HELD` or its
    negative: then a part of a step that ends at the switch sees one side of it alone. Two events without effects end
    such parts, one where the guard becomes positive and one where it becomes negative; the last events of a Model are
    those of its switches, in their order.
    """

    symbol: sympy.Symbol
    guard: Expr


HELD = 1e30
"""A number beyond any guard; single precision has it."""
