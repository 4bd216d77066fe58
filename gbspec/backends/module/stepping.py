"""The methods `grid` and `step` of the generated class: one step of an integration method."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import assert_never

from gbspec.backends.module.writing import comma, left_side, method_text
from gbspec.ir import Explicit, Method, RosenbrockW

SIMPLE = 10**6
"""Fractions with larger denominators are written as decimal numbers."""


def solver_methods(method: Method) -> list[str]:
    """`grid` and `step`: one step of an integration method."""
    match method:
        case Explicit():
            return [
                _grid_method(method, [_multiple(factor, "column") for factor in _sizes(method)]),
                _step_method(method),
            ]
        case RosenbrockW():
            return [_grid_method(method, ["column"]), _rosenbrock_method(method)]
        case _:
            assert_never(method)


def _grid_method(method: Method, sizes: Sequence[str]) -> str:
    """`grid`: times and sizes within a step, for `step`."""
    times = ", ".join(map(step_time, method.nodes))
    body = ["column = math.column(h)  # to multiply vectors", f"return ({times}), ({comma(sizes)})"]
    document = (
        f"The nodes of a step of size h from t ({method.name.upper()}): times of its inputs, and fractions of its size."
    )
    return method_text("@staticmethod", "grid", ["math", "t", "h"], document, body)


def _step_method(method: Explicit) -> str:
    """`step`: one step of an explicit Runge-Kutta method."""
    nodes = method.nodes
    sizes = left_side(_size_name(factor) for factor in _sizes(method))
    body = [
        f"({left_side(f't{i}' for i in range(len(nodes)))}), ({sizes}) = grid",
        f"{left_side(f'u{i}' for i in range(len(nodes)))} = inputs",
    ]
    for i, (row, c) in enumerate(zip(method.a[: method.advancing], method.c, strict=False)):
        node = nodes.index(c)
        body.append(f"k{i + 1} = rhs(t{node}, {_ahead(row)}, u{node})")
    body.append(f"return {_ahead(method.b)}")
    times = ", ".join(map(step_time, nodes))
    document = f"One step ({method.name.upper()}) of state' = rhs(time, state, inputs); `inputs` are those at {times}."
    return method_text("@staticmethod", "step", ["math", "rhs", "grid", "state", "inputs"], document, body)


def _rosenbrock_method(method: RosenbrockW) -> str:
    """`step`: one step of a Rosenbrock-W method."""
    nodes = method.nodes
    body = [
        f"({left_side(f't{i}' for i in range(len(nodes)))}), (h,) = grid",
        f"{left_side(f'u{i}' for i in range(len(nodes)))} = inputs",
        f"solve = solve or math.factored(rhs, t0, state, u0, {float(method.gamma)!r} * h)",
    ]
    for i, (row, coupling, c) in enumerate(zip(method.a, method.coupling, method.c, strict=True)):
        at = f"math.ahead(state, h, {_weighted(row)})" if any(row) else "state"
        rate = f"rhs(t{nodes.index(c)}, {at}, u{nodes.index(c)})"
        if any(coupling):
            body.append(f"v{i + 1} = {_weighted(coupling)}")
        body.append(f"k{i + 1} = solve({rate} + v{i + 1}) - v{i + 1}" if any(coupling) else f"k{i + 1} = solve({rate})")
    body.append(f"return math.ahead(state, h, {_weighted(method.b)})")
    times = ", ".join(map(step_time, nodes))
    document = (
        f"One step ({method.name.upper()}) of state' = rhs(time, state, inputs); `inputs` are those at {times}.\n\n"
        "`solve` divides by I - gamma h W; without it W is the Jacobian at the step's start."
    )
    return method_text(
        "@staticmethod", "step", ["math", "rhs", "grid", "state", "inputs", "solve=None"], document, body
    )


def _weighted(row: Sequence[Fraction]) -> str:
    """A weighted sum of Runge-Kutta stages, with decimal weights."""
    terms = (f"{float(b)!r} * k{i + 1}" if b != 1 else f"k{i + 1}" for i, b in enumerate(row) if b)
    return " + ".join(terms).replace("+ -", "- ")


def _sizes(method: Explicit) -> list[Fraction]:
    """The fractions of a step by which sums of Runge-Kutta stages are multiplied."""
    return sorted({_unit(row) for row in (*method.a[: method.advancing], method.b) if any(row)})


def _unit(row: Sequence[Fraction]) -> Fraction:
    """The smallest positive weight; one exists, since no node is before the step."""
    return min(weight for weight in row if weight > 0)


def _size_name(factor: Fraction) -> str:
    """`h`, `h_2` for h/2, `h2_3` for 2*h/3."""
    above = "h" if factor.numerator == 1 else f"h{factor.numerator}"
    return above if factor.denominator == 1 else f"{above}_{factor.denominator}"


def _ahead(row: Sequence[Fraction]) -> str:
    """The state plus the weighted sum of Runge-Kutta stages; stages with equal weights are added first."""
    if not any(row):
        return "state"
    unit = _unit(row)
    ratios = sorted({b / unit for b in row if b}, key=lambda ratio: (ratio != 1, ratio))
    sums = [" + ".join(f"k{i + 1}" for i, b in enumerate(row) if b == ratio * unit) for ratio in ratios]
    total = sums[0]
    for ratio, stages in zip(ratios[1:], sums[1:], strict=True):
        total = f"math.ahead({total}, {ratio}, {stages})"
    return f"math.ahead(state, {_size_name(unit)}, {total})"


def step_time(c: Fraction) -> str:
    """The time at a fraction of a step: `t`, `t + h/2`."""
    return "t" if c == 0 else f"t + {_multiple(c, 'h')}"


def _multiple(factor: Fraction, name: str) -> str:
    """`h/2`, `2*h`, `h`; `0.87*h` for a factor that is not simple."""
    if factor.denominator > SIMPLE:
        return f"{float(factor)!r}*{name}"
    above = name if factor.numerator == 1 else f"{factor.numerator}*{name}"
    return above if factor.denominator == 1 else f"{above}/{factor.denominator}"
