"""Textbook systems written directly in CasADi, with published numbers as references for the tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

from gbspec.analysis.systems.system import System


def textbook(
    name: str,
    states: tuple[str, ...],
    rhs: Callable[..., tuple[Any, ...]],
    conditions: Mapping[str, float],
    ranges: Mapping[str, tuple[float, float]],
    declared: bool = False,
) -> System:
    """A system whose right-hand side is a function of states and conditions by name; NaN means no default."""
    t, x, u, k = ca.SX.sym("t"), ca.SX.sym("x", len(states)), ca.SX.sym("u", 0), ca.SX.sym("k", 0)
    c = ca.SX.sym("c", len(conditions))
    values = {**dict(zip(states, ca.vertsplit(x), strict=True)), **dict(zip(conditions, ca.vertsplit(c), strict=True))}
    function = ca.Function("rhs", [t, x, c, u, k], [ca.vertcat(*rhs(**values))])
    return System(
        name=name,
        states=states,
        rhs=function,
        conditions=tuple(conditions),
        values={key: value for key, value in conditions.items() if value == value},
        ranges=ranges,
        declared=frozenset(ranges) if declared else frozenset(),
    )


def urp(Da: float = float("nan"), B: float = 11.0, beta: float = 3.0) -> System:
    """The non-isothermal CSTR of Uppal, Ray and Poore (Chem. Eng. Sci. 29, 1974), as the paper prints it."""

    def rhs(x1: Any, x2: Any, Da: Any, B: Any, beta: Any) -> tuple[Any, ...]:
        phi = Da * (1 - x1) * ca.exp(x2)
        return -x1 + phi, -x2 + B * phi - beta * x2

    ranges = {"x1": (0.0, 1.0), "x2": (0.0, 6.0), "Da": (0.2, 0.5)}
    return textbook("urp", ("x1", "x2"), rhs, {"Da": Da, "B": B, "beta": beta}, ranges)


def baltzis_fredrickson(inverse_alpha: float = 7.3 * 0.68) -> System:
    """Three species in a chemostat (Baltzis and Fredrickson, Biotechnol. Bioeng. 26, 1984), as the paper scales it."""

    def rhs(x: Any, y: Any, z: Any, u: Any, v: Any, g: Any, theta: Any) -> tuple[Any, ...]:
        alpha = 1 / theta
        host, first, second = u / ((1 + u) * (1 + g)) * x, 0.2941176 * v / (1 + v) * y, 0.367647 * v / (10 + v) * z
        return (
            host - (alpha + 0.367647) * x,
            first - (alpha + 0.117647) * y,
            second - (alpha + 0.1617647) * z,
            alpha * (250 - u) - host,
            -alpha * v + 9.7 * host - first - 10 * second,
            -alpha * g + 0.13138686 * first + 1.29166 * second,
        )

    ranges = {
        "x": (0.0, 100.0),
        "y": (0.0, 5.0),
        "z": (0.0, 2.0),
        "u": (0.0, 250.0),
        "v": (0.0, 3000.0),
        "g": (0.0, 2.0),
    }
    return textbook("bf", tuple(ranges), rhs, {"theta": inverse_alpha}, {**ranges, "theta": (4.0, 6.0)}, declared=True)


def brusselator(A: float = 1.0, B: float = float("nan")) -> System:
    """Prigogine and Lefever (J. Chem. Phys. 48, 1968): x = A, y = B/A, Hopf point at B = 1 + A^2."""

    def rhs(x: Any, y: Any, A: Any, B: Any) -> tuple[Any, ...]:
        return A - (B + 1) * x + x**2 * y, B * x - x**2 * y

    return textbook("brusselator", ("x", "y"), rhs, {"A": A, "B": B}, {"x": (0.0, 5.0), "y": (0.0, 5.0)})


def van_der_pol(mu: float = float("nan")) -> System:
    """van der Pol (Phil. Mag. 2, 1926)."""

    def rhs(x: Any, y: Any, mu: Any) -> tuple[Any, ...]:
        return y, mu * (1 - x**2) * y - x

    return textbook("van_der_pol", ("x", "y"), rhs, {"mu": mu}, {"x": (-3.0, 3.0), "y": (-3.0, 3.0)})


def lorenz(r: float = float("nan")) -> System:
    """Lorenz (J. Atmos. Sci. 20, 1963), sigma = 10, b = 8/3."""

    def rhs(x: Any, y: Any, z: Any, r: Any) -> tuple[Any, ...]:
        return 10 * (y - x), r * x - y - x * z, x * y - 8 / 3 * z

    ranges = {"x": (-20.0, 20.0), "y": (-20.0, 20.0), "z": (0.0, 40.0)}
    return textbook("lorenz", ("x", "y", "z"), rhs, {"r": r}, ranges)


def cusp(h: float = float("nan"), r: float = 1.0) -> System:
    """The cusp normal form x' = h + r x - x^3 (Strogatz, section 3.6): folds at h = -+ 2/3 r sqrt(r/3)."""

    def rhs(x: Any, h: Any, r: Any) -> tuple[Any, ...]:
        return (h + r * x - x**3,)

    return textbook("cusp", ("x",), rhs, {"h": h, "r": r}, {"x": (-2.0, 2.0)})


def pitchfork(r: float = float("nan")) -> System:
    """x' = r x - x^3: a branch point at r = 0."""
    return textbook("pitchfork", ("x",), lambda x, r: (r * x - x**3,), {"r": r}, {"x": (-1.5, 1.5)})


def morris_lecar(current: float = float("nan")) -> System:
    """Morris and Lecar (Biophys. J. 35, 1981), the Hopf case of Ermentrout and Terman (2010), Table 3.1."""

    def rhs(V: Any, n: Any, current: Any) -> tuple[Any, ...]:
        m = 0.5 * (1 + ca.tanh((V + 1.2) / 18))
        steady, rate = 0.5 * (1 + ca.tanh((V - 2) / 30)), 0.04 * ca.cosh((V - 2) / 60)
        ionic = 4.4 * m * (V - 120) + 8 * n * (V + 84) + 2 * (V + 60)
        return (current - ionic) / 20, rate * (steady - n)

    return textbook("morris_lecar", ("V", "n"), rhs, {"current": current}, {"V": (-70.0, 50.0), "n": (0.0, 1.0)})


def roessler(c: float = float("nan")) -> System:
    """Roessler (Phys. Lett. A 57, 1976), a = b = 0.2."""

    def rhs(x: Any, y: Any, z: Any, c: Any) -> tuple[Any, ...]:
        return -y - z, x + 0.2 * y, 0.2 + z * (x - c)

    ranges = {"x": (-8.0, 8.0), "y": (-8.0, 8.0), "z": (0.0, 12.0)}
    return textbook("roessler", ("x", "y", "z"), rhs, {"c": c}, ranges)
