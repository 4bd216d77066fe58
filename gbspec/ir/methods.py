"""Integrators as data: adding a method of a kind that there is takes one entry of `METHODS` and no other change.

All code that takes steps reads the method from here: the generated module, the native kernel, casadi and its C code,
the packing of inputs, and `--solver`. `docs/architecture.md` ("Integrators") describes the kinds.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TypeAlias

from gbspec.diagnostics import Diagnostic, UserError

Row = tuple[Fraction, ...]


@dataclass(frozen=True)
class Explicit:
    """An explicit Runge-Kutta method, by its exact Butcher tableau.

    Runge-Kutta stage i is the right-hand side at `t + c[i] h` and `x + h sum_j a[i][j] k_j`; a step adds
    `h sum_i b[i] k_i`. `h sum_i b_error[i] k_i` estimates the error of a step: the difference to an embedded method of
    order `embedded_order`. `source` is where the coefficients are from, `help` a line for users.

    Raises ValueError if rows have wrong lengths, or a node lies outside the step, where inputs are unknown.
    """

    name: str
    order: int
    a: tuple[Row, ...]
    b: Row
    source: str
    help: str
    b_error: Row | None = None
    embedded_order: int | None = None

    def __post_init__(self) -> None:
        fits = all(len(row) == i for i, row in enumerate(self.a)) and len(self.b) == len(self.a)
        if not fits or (self.b_error is not None and len(self.b_error) != len(self.a)):
            raise ValueError(f"the tableau of `{self.name}` is not that of an explicit method")
        if not all(0 <= c <= 1 for c in self.c):
            raise ValueError(f"a node of `{self.name}` lies outside the step")

    @cached_property
    def c(self) -> Row:
        """The nodes of the Runge-Kutta stages as fractions of the step: the sums of the rows."""
        return tuple(sum(row, Fraction(0)) for row in self.a)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs at the nodes in functions of one step: `u0`, `u1`, ..."""
        return tuple(f"u{i}" for i in range(len(self.nodes)))

    @cached_property
    def advancing(self) -> int:
        """The number of Runge-Kutta stages that a step needs; later ones are used only by the error estimate."""
        return max(i + 1 for i, weight in enumerate(self.b) if weight)

    @cached_property
    def nodes(self) -> Row:
        """The distinct fractions of a step at which inputs are needed, in increasing order.

        The step's ends are always among them, since the slopes of inputs are computed from these.
        """
        return tuple(sorted({Fraction(0), Fraction(1), *self.c[: self.advancing]}))


@dataclass(frozen=True)
class RosenbrockW:
    """A Rosenbrock-W method: with any constant matrix M = h W, at best W = df/dx at the step's start,

        (I - gamma M) k_i = f(t + c[i] h, x + h sum_j a[i][j] k_j) + M sum_j g[i][j] k_j,    x + h sum_i b[i] k_i.

    Its order does not depend on M, on which only its stability does. Coefficients are exact decimals of what was
    published; `b_error` and `embedded_order` are those of the error estimate, as for explicit methods.

    Raises ValueError if rows have wrong lengths, or a node lies outside the step.
    """

    name: str
    order: int
    gamma: Fraction
    a: tuple[Row, ...]
    g: tuple[Row, ...]
    b: Row
    source: str
    help: str
    b_error: Row
    embedded_order: int

    def __post_init__(self) -> None:
        rows = (*self.a, *self.g)
        count = len(self.b)
        fits = all(len(row) == i % count for i, row in enumerate(rows)) and len(rows) == 2 * count
        if not fits or len(self.b_error) != count or not self.gamma > 0:
            raise ValueError(f"the coefficients of `{self.name}` are not those of a Rosenbrock-W method")
        if not all(0 <= c <= 1 for c in self.c):
            raise ValueError(f"a node of `{self.name}` lies outside the step")

    @cached_property
    def c(self) -> Row:
        """The nodes of the Runge-Kutta stages as fractions of the step."""
        return tuple(sum(row, Fraction(0)) for row in self.a)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs at the nodes in functions of one step."""
        return tuple(f"u{i}" for i in range(len(self.nodes)))

    @property
    def advancing(self) -> int:
        """The number of Runge-Kutta stages of a step."""
        return len(self.b)

    @cached_property
    def nodes(self) -> Row:
        """The distinct fractions of a step at which inputs are needed, in increasing order, with both ends."""
        return tuple(sorted({Fraction(0), Fraction(1), *self.c}))

    @cached_property
    def coupling(self) -> tuple[Row, ...]:
        """`g / gamma`: with v_i = sum_j coupling[i][j] k_j, k_i = (I - gamma M)^-1 (f_i + v_i) - v_i needs no M."""
        return tuple(tuple(value / self.gamma for value in row) for row in self.g)


Method: TypeAlias = Explicit | RosenbrockW
"""Every kind of method. Match on it with `assert_never`, so that mypy reports places that lack a new kind."""


def _row(text: str) -> Row:
    return tuple(map(Fraction, text.split()))


def _rows(*texts: str) -> tuple[Row, ...]:
    return tuple(map(_row, texts))


RK4 = Explicit(
    "rk4",
    4,
    a=_rows("", "1/2", "0 1/2", "0 0 1"),
    b=_row("1/6 1/3 1/3 1/6"),
    source="Kutta (1901), Z. Math. Phys. 46, 435",
    help="the classical method of order 4",
)
"""The default integrator."""

RK38 = Explicit(
    "rk38",
    4,
    a=_rows("", "1/3", "-1/3 1", "1 -1 1"),
    b=_row("1/8 3/8 3/8 1/8"),
    source="Kutta (1901), Z. Math. Phys. 46, 435",
    help="Kutta's 3/8 rule, of order 4",
)

DOPRI5 = Explicit(
    "dopri5",
    5,
    a=_rows(
        "",
        "1/5",
        "3/40 9/40",
        "44/45 -56/15 32/9",
        "19372/6561 -25360/2187 64448/6561 -212/729",
        "9017/3168 -355/33 46732/5247 49/176 -5103/18656",
        "35/384 0 500/1113 125/192 -2187/6784 11/84",
    ),
    b=_row("35/384 0 500/1113 125/192 -2187/6784 11/84 0"),
    b_error=_row("71/57600 0 -71/16695 71/1920 -17253/339200 22/525 -1/40"),
    embedded_order=4,
    source="Dormand and Prince (1980), J. Comput. Appl. Math. 6, 19",
    help="the method of Dormand and Prince, of order 5",
)
"""The last Runge-Kutta stage is the first of the next step; it serves the error estimate."""

ROS34PW2 = RosenbrockW(
    "ros34pw2",
    3,
    gamma=Fraction("0.435866521508459"),
    a=_rows("", "0.87173304301691801", "0.84457060015369423 -0.11299064236484185", "0 0 1"),
    g=_rows(
        "",
        "-0.87173304301691801",
        "-0.90338057013044082 0.054180672388095326",
        "0.24212380706095346 -1.2232505839045147 0.54526025533510214",
    ),
    b=_row("0.24212380706095346 -1.2232505839045147 1.545260255335102 0.435866521508459"),
    b_error=_row("-0.13598522439724023 -1.12720829169209152 1.045260255335102 0.2179332607542295"),
    embedded_order=2,
    source="Rang and Angermann (2005), BIT Numer. Math. 45, 761",
    help="a Rosenbrock-W method of order 3 for stiff equations (L-stable, stiffly accurate), with adaptive steps",
)

METHODS: dict[str, Method] = {method.name: method for method in (RK4, RK38, DOPRI5, ROS34PW2)}
"""Every method by its name after `--solver`."""

STIFF = ROS34PW2
"""The method that `--solver auto` takes for stiff equations."""


AUTO = "auto"
"""The name after `--solver` that lets the training choose."""


def listed() -> str:
    """The names of the methods with their descriptions, for a help line."""
    return "; ".join(f"`{name}`, {method.help}" for name, method in METHODS.items())


def unknown_method(name: str) -> Diagnostic:
    """The diagnostic (GB850) for a name that no method has."""
    known = ", ".join(f"`{each}`" for each in (*METHODS, AUTO))
    return Diagnostic("GB850", f"`--solver {name}` must be one of {known}", None, subject="solver")


def method_named(name: str) -> Method:
    """The method with a given name. Raises UserError (GB850)."""
    if name not in METHODS:
        raise UserError([unknown_method(name)])
    return METHODS[name]
