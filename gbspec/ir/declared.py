"""What every declared name has, and ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import sympy

from gbspec.diagnostics import Span
from gbspec.ir.symbols import symbol

LOGARITHMIC_FROM = 100.0
"""Ratio of two bounds of the same sign from which logarithms are the scale of a constant, as for default starting
values."""


@dataclass(frozen=True)
class Range:
    """A closed interval; either end may be infinite."""

    low: float = -math.inf
    high: float = math.inf

    @property
    def bounded(self) -> bool:
        """Whether both ends are finite."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    @property
    def logarithmic(self) -> bool:
        """Whether the bounds say that an order of magnitude is unknown: two of one sign, far apart."""
        if not self.bounded or self.low * self.high <= 0:
            return False
        return max(self.low / self.high, self.high / self.low) >= LOGARITHMIC_FROM


UNBOUNDED = Range()
"""All numbers."""


@dataclass(frozen=True)
class Declared:
    """The attributes of every declared name. `unit` is the text of its unit (canonical form), None without one."""

    name: str
    unit: str | None = field(default=None, kw_only=True)
    description: str = field(default="", kw_only=True)
    span: Span | None = field(default=None, kw_only=True, compare=False, repr=False)

    @property
    def symbol(self) -> sympy.Symbol:
        """The symbol of the name."""
        return symbol(self.name)
