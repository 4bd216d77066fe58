"""Explicit Runge-Kutta methods as data: a new integrator is a new entry."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True)
class Tableau:
    """An explicit Butcher tableau: stage i sees x + h sum_j a[i][j] k_j at t + c[i] h; a step adds h sum_i b[i] k_i."""

    name: str
    order: int
    a: tuple[tuple[Fraction, ...], ...]
    b: tuple[Fraction, ...]
    c: tuple[Fraction, ...]


_F = Fraction

RK4 = Tableau(
    "rk4",
    4,
    a=((), (_F(1, 2),), (_F(0), _F(1, 2)), (_F(0), _F(0), _F(1))),
    b=(_F(1, 6), _F(1, 3), _F(1, 3), _F(1, 6)),
    c=(_F(0), _F(1, 2), _F(1, 2), _F(1)),
)
"""The classical method of Kutta (1901), the integrator of the paper."""
