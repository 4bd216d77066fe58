"""Small hand-made models."""

from __future__ import annotations

import sympy

from gbspec.ir.model import (
    NN,
    Argument,
    Channel,
    Condition,
    Constant,
    Dose,
    Initial,
    Input,
    Intermediate,
    Learnable,
    Model,
    Network,
    Range,
    State,
    Time,
    Unknown,
    symbol,
    unknown_function,
)


def reactor() -> Model:
    """A stirred tank: one unknown of three arguments, one condition, two learnables."""
    x1, x2, da, b, beta = map(symbol, ("x1", "x2", "Da", "B", "beta"))
    phi = unknown_function("phi")(x1, x2, da)
    return Model(
        name="urp_gb2",
        title="Non-isothermal CSTR, kinetics and coupling constants unknown",
        states=(
            State("x1", range=Range(0.0, 1.0), description="conversion"),
            State("x2", description="dimensionless temperature"),
        ),
        conditions=(Condition("Da", range=Range(0.2, 0.5), description="Damkoehler number"),),
        learnables=(Learnable("B", start=5.0, range=Range(0.0, 50.0)), Learnable("beta", start=1.0)),
        networks=(Network(("phi",), (Argument("x1"), Argument("x2"), Argument("Da", range=Range(0.2, 0.5))), (8, 8)),),
        unknowns=(Unknown("phi", description="reaction rate"),),
        balances=(-x1 + phi, -x2 + b * phi - beta * x2),
        channels=(Channel("x1", value=x1, state=0), Channel("x2", value=x2, state=1)),
    )


def clinic() -> Model:
    """All constructs: names to be mangled, two networks, postulates, a let, inputs, a dose, given initial values."""
    x, k, state, u, t, g, total = map(symbol, ("x", "lambda", "state", "u", "t", "g", "total"))
    q, h = unknown_function("q"), unknown_function("h")
    return Model(
        name="clinic",
        title='Tanks "in a row"',
        time=Time("t", unit="h"),
        states=(
            State("x", unit="mg", description="amount"),
            State("state", initial=Initial("expression", 2 * k + x)),
            State("g"),
        ),
        inputs=(Input("u", unit="mg/h", interpolation="linear", default=0.5),),
        constants=(Constant("g0", value=0.1),),
        learnables=(Learnable("lambda", start=1.5, range=Range(0.0), per_trajectory=True),),
        networks=(
            Network(("q",), (Argument("S", range=Range(0.0, 5.0)),), (4,), "tanh"),
            Network(("h", "r"), (Argument("x"), Argument("g")), (3, 3)),
        ),
        unknowns=(
            Unknown("q", postulate=symbol("S") / (k + symbol("S")) * NN, neutral=1.0),
            Unknown("h", network=1, output=0),
            Unknown("r", network=1, output=1, postulate=symbol("g0") + NN),
        ),
        intermediates=(Intermediate("total", value=x + state, description="both tanks"),),
        balances=(
            u - q(x) * total,
            q(x) - q(state + 1) + sympy.Piecewise((sympy.sqrt(g), g > 0), (0, True)),
            h(x, g) * sympy.Max(g, sympy.Rational(1, 3)) - unknown_function("r")(x, g) / (1 + total**2) + t,
        ),
        channels=(Channel("x", value=x, state=0), Channel("both", value=total, column="both tanks")),
        doses=(Dose("x", fraction=k / 2, lag=symbol("g0")),),
    )
