"""The symbolic truth: a model's expressions at 30 digits by mpmath, its networks written out here once more."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray

from gbspec.ir.model import NN, Expr, Model
from gbspec.ir.tableaus import RK4
from tests.strategies import Point

Array = NDArray[np.float64]

ACTIVATIONS: Mapping[str, Callable[[Any], Any]] = {
    "silu": lambda z: z / (1 + mpmath.exp(-z)),
    "tanh": mpmath.tanh,
    "softplus": lambda z: mpmath.log(1 + mpmath.exp(z)),
    "relu": lambda z: max(z, mpmath.mpf(0)),
    "gelu": lambda z: z / 2 * (1 + mpmath.erf(z / mpmath.sqrt(2))),
    "sigmoid": lambda z: 1 / (1 + mpmath.exp(-z)),
    "elu": lambda z: z if z > 0 else mpmath.expm1(z),
    "sin": mpmath.sin,
}


class Truth:
    """A model with weights, evaluated at 30 digits."""

    def __init__(self, model: Model, weights: Mapping[str, Array]) -> None:
        self.model, self.weights = model, weights
        self.unknowns = {unknown.name: self._unknown(unknown) for unknown in model.unknowns}

    def rhs(self, point: Point) -> list[Any]:
        """dx/dt."""
        return self._evaluate(self.model.inlined(self.model.balances), point)

    def observe(self, point: Point) -> list[Any]:
        """The channels."""
        return self._evaluate(self.model.inlined(c.value for c in self.model.channels), point)

    def initial(self, point: Point) -> list[Any]:
        """The start with expressed starts put in, one after the other until none hangs on another."""
        found = list(point.x)
        for _ in self.model.states:
            at = Point(point.t, found, point.condition, point.inputs, point.constants)  # type: ignore[arg-type]
            for i, state in enumerate(self.model.states):
                if state.initial.value is not None:
                    found[i] = self._evaluate([state.initial.value], at)[0]
        return found

    def step(self, point: Point, h: float) -> list[Any]:
        """One step of the classical Runge-Kutta method."""
        with mpmath.workdps(30):
            slopes: list[list[Any]] = []
            for row, c in zip(RK4.a, RK4.c, strict=True):
                x = [
                    mpmath.mpf(value) + sum(mpmath.mpf(h) * _mp(a) * slopes[j][i] for j, a in enumerate(row))
                    for i, value in enumerate(point.x)
                ]
                at = Point(mpmath.mpf(point.t) + _mp(c) * h, x, point.condition, point.inputs, point.constants)  # type: ignore[arg-type]
                slopes.append(self.rhs(at))
            return [
                mpmath.mpf(value) + sum(mpmath.mpf(h) * _mp(b) * slopes[j][i] for j, b in enumerate(RK4.b))
                for i, value in enumerate(point.x)
            ]

    def _evaluate(self, expressions: Sequence[Expr], point: Point) -> list[Any]:
        model = self.model
        names = [model.time, *model.states, *model.conditions, *model.inputs, *model.constants, *model.learnables]
        values = [point.t, *point.x, *point.condition, *point.inputs, *point.constants]
        self.table = {
            item.symbol: mpmath.mpf(value)
            for item, value in zip((*model.constants, *model.learnables), point.constants, strict=True)
        }
        with mpmath.workdps(30):
            return [self._value(expression, names, values) for expression in expressions]

    def _value(self, expression: Expr, names: Sequence[Any], values: Sequence[Any]) -> Any:
        return _lambdify([item.symbol for item in names], expression, self.unknowns)(*map(mpmath.mpf, values))

    def _unknown(self, unknown: Any) -> Callable[..., Any]:
        network = self.model.networks[unknown.network]
        formals = [argument.symbol for argument in network.arguments]

        def value(*arguments: Any) -> Any:
            raw = self._network(unknown.network, arguments)[unknown.output]
            constants = [key for key in self.table if key not in formals]
            function = _lambdify([NN, *formals, *constants], unknown.postulate, {})
            return function(raw, *arguments, *(self.table[key] for key in constants))

        return value

    def _network(self, index: int, arguments: Sequence[Any]) -> list[Any]:
        network = self.model.networks[index]

        def numbers(name: str) -> Any:
            return np.vectorize(mpmath.mpf, otypes=[object])(self.weights[f"network.{network.name}.{name}"])

        a = (np.array(arguments, dtype=object) - numbers("input_center")) / numbers("input_scale")
        for layer in range(len(network.hidden) + 1):
            if layer:
                a = np.array([ACTIVATIONS[network.activation](z) for z in a], dtype=object)
            a = numbers(f"{layer}.weight").dot(a) + numbers(f"{layer}.bias")
        return list(numbers("output_center") + numbers("output_scale") * a)


def _lambdify(symbols: Sequence[Any], expression: Expr, functions: Mapping[str, Any]) -> Callable[..., Any]:
    """sympy's own function of an expression at mpmath's precision, under names that cannot clash."""
    plain = [sympy.Symbol(f"a{i}", real=True) for i in range(len(symbols))]
    renamed = {sympy.Function(name, real=True): sympy.Function(f"f{i}") for i, name in enumerate(functions)}
    expression = sympy.sympify(expression).xreplace(dict(zip(symbols, plain, strict=True)))
    expression = expression.replace(
        lambda node: isinstance(node, sympy.core.function.AppliedUndef),
        lambda node: renamed[sympy.Function(node.func.__name__, real=True)](*node.args),
    )
    table = {f"f{i}": function for i, function in enumerate(functions.values())}
    return sympy.lambdify(plain, expression, modules=[table, "mpmath"])  # type: ignore[no-any-return]


def _mp(fraction: Any) -> Any:
    return mpmath.mpf(fraction.numerator) / fraction.denominator
