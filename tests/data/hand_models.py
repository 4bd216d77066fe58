"""Small models built by hand."""

from __future__ import annotations

import sympy

from gbspec.ir.model import Channel, Condition, Dose, Expr, Initial, Input, Model, Noise, Range, State, Time, symbol


def reactor(**changes: object) -> Model:
    """States x1 and x2, both measured, and a condition Da."""
    states = (State("x1", range=Range(0.0, 1.0)), State("x2", range=Range(0.0, 10.0)))
    fields: dict[str, object] = {
        "states": states,
        "conditions": (Condition("Da", range=Range(0.0, 1.0)),),
        "channels": tuple(Channel(s.name, value=symbol(s.name), state=i) for i, s in enumerate(states)),
    }
    return Model("reactor", **{**fields, **changes})  # type: ignore[arg-type]  # fields of a Model by name


def tank(interpolation: str = "held", default: float | None = None) -> Model:
    """A state V, measured, and an input F."""
    return Model(
        "tank",
        states=(State("V"),),
        inputs=(Input("F", interpolation=interpolation, default=default),),  # type: ignore[arg-type]  # one of the two
        channels=(Channel("V", value=symbol("V"), state=0),),
    )


def patient() -> Model:
    """A state S with doses, measured with lognormal noise under another column's name; time starts at 0."""
    return Model(
        "patient",
        time=Time("t", start=0.0),
        states=(State("S"),),
        channels=(Channel("S", value=symbol("S"), state=0, noise=Noise("lognormal", 0.1), column="plasma mg/L"),),
        doses=(Dose("S"),),
    )


def decay() -> Model:
    """A state x, measured; time starts at 0."""
    channel = Channel("x", value=symbol("x"), state=0)
    return Model("decay", time=Time("t", start=0.0), states=(State("x"),), channels=(channel,))


def growth() -> Model:
    """A state x, measured with lognormal noise."""
    channel = Channel("x", value=symbol("x"), state=0, noise=Noise("lognormal", 0.1))
    return Model("growth", states=(State("x"),), channels=(channel,))


def drip(
    duration: Expr | None = sympy.S.Zero,
    initial: Initial = Initial("expression", sympy.S.Zero),  # noqa: B008 - immutable
    conditions: tuple[Condition, ...] = (),
    lag: Expr = sympy.S.Zero,
) -> Model:
    """A state x, measured, with doses that last `duration` where a table does not say it; None: never."""
    name = "" if duration is None else "infusion_x"
    return Model(
        "drip",
        time=Time("t", start=0.0),
        states=(State("x", initial=initial),),
        conditions=conditions,
        inputs=(Input(name, default=0.0, column=name, infuses="x"),) if name else (),
        balances=(-symbol("x") + (symbol(name) if name else 0),),
        channels=(Channel("x", value=symbol("x"), state=0),),
        doses=(Dose("x", lag=lag, duration=duration, infusion=name),),
    )
