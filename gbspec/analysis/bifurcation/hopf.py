"""Hopf points: the first Lyapunov coefficient, and with it whether the cycles born there are stable.

Kuznetsov, Elements of Applied Bifurcation Theory (3rd ed.), equation (5.62), with A q = i w q, A^T p = -i w p,
<q, q> = 1, <p, q> = 1 and exact second and third derivatives B and C:

    l1 = 1/(2 w) Re( <p, C(q, q, conj q)> - 2 <p, B(q, A^-1 B(q, conj q))> + <p, B(conj q, (2 i w I - A)^-1 B(q, q))> )
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbspec.analysis.systems import Family
from gbspec.arrays import Array, ComplexArray


@dataclass(frozen=True)
class Hopf:
    """What a Hopf point says of the cycles born there: frequency w, critical eigenvector q [n], and l1."""

    frequency: float
    vector: ComplexArray
    l1: float

    @property
    def period(self) -> float:
        """The period of infinitely small cycles."""
        return 2.0 * np.pi / self.frequency

    @property
    def criticality(self) -> Literal["super", "sub"]:
        """`super`: stable small cycles where the steady state is unstable; `sub`: unstable ones on the other side."""
        return "super" if self.l1 < 0.0 else "sub"


def critical_pair(jacobian: Array) -> tuple[float, ComplexArray, ComplexArray]:
    """w, q and p of the complex pair closest to the imaginary axis, normalised as above."""
    values, right = np.linalg.eig(jacobian)
    complex_ones = np.flatnonzero(values.imag > 0.0)
    index = complex_ones[np.argmin(np.abs(values.real[complex_ones]))]
    frequency = float(values[index].imag)
    q = right[:, index] / np.linalg.norm(right[:, index])
    values, left = np.linalg.eig(jacobian.T)
    p = left[:, int(np.argmin(np.abs(values + 1j * frequency)))]
    return frequency, q, p / np.conj(np.vdot(p, q))


def analyse_hopf(family: Family, state: Array, value: float) -> Hopf:
    """The first Lyapunov coefficient at a Hopf point: state [n] and parameter."""
    n = family.size
    return normal_form(
        family.linear(state, value)[1].reshape(n, n),
        lambda u, v: family.bilinear(state, value, u, v)[0],
        lambda u, v, w: family.trilinear(state, value, u, v, w)[0],
    )


def normal_form(
    jacobian: Array,
    second: Callable[[Array, Array], Array],
    third: Callable[[Array, Array, Array], Array],
) -> Hopf:
    """The same from the Jacobian [n, n] and the derivatives B(u, v) and C(u, v, w) of real vectors [n]."""
    frequency, q, p = critical_pair(jacobian)

    def bilinear(u: ComplexArray, v: ComplexArray) -> ComplexArray:
        straight = second(u.real, v.real) - second(u.imag, v.imag)
        return straight + 1j * (second(u.real, v.imag) + second(u.imag, v.real))

    r, s = q.real, q.imag
    cubic = third(r, r, r) + third(r, s, s) + 1j * (third(r, r, s) + third(s, s, s))
    static = np.linalg.solve(jacobian, bilinear(q, q.conj())).astype(complex)
    double = np.linalg.solve(2j * frequency * np.eye(len(q)) - jacobian, bilinear(q, q)).astype(complex)
    total = np.sum(p.conj() * (cubic - 2.0 * bilinear(q, static) + bilinear(q.conj(), double)))
    return Hopf(frequency, q, float(total.real) / (2.0 * frequency))
