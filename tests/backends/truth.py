"""The symbolic reference: a model's expressions at 30 digits by mpmath, with independently implemented networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray

from gbspec.ir.forms import described, logistic, softplus
from gbspec.ir.methods import RK4, Method, RosenbrockW
from gbspec.ir.model import NN, Expr, Model, Network
from gbspec.ir.tables import Lookup
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
        self.model = model
        self.weights = {name: np.vectorize(mpmath.mpf, otypes=[object])(value) for name, value in weights.items()}
        self.unknowns = {unknown.name: self._unknown(unknown) for unknown in model.unknowns}

    def rhs(self, point: Point) -> list[Any]:
        """dx/dt."""
        return self._evaluate(self.model.balances, point)

    def observe(self, point: Point) -> list[Any]:
        """The channels."""
        return self._evaluate([c.value for c in self.model.channels], point)

    def initial(self, point: Point) -> list[Any]:
        """The initial state with given initial values inserted, repeated until all dependencies are resolved."""
        found = list(point.x)
        for _ in self.model.states:
            at = Point(point.t, found, point.condition, point.inputs, point.constants)  # type: ignore[arg-type]
            for i, state in enumerate(self.model.states):
                if state.initial.value is not None:
                    found[i] = self._evaluate([state.initial.value], at)[0]
        return found

    def step(self, point: Point, h: float, method: Method = RK4) -> list[Any]:
        """One step of a method, by its coefficients."""
        with mpmath.workdps(30):
            slopes: list[list[Any]] = []
            matrix = mpmath.mpf(h) * self.slopes(point) if isinstance(method, RosenbrockW) else None
            for stage, (row, c) in enumerate(zip(method.a, method.c, strict=True)):
                x = [
                    mpmath.mpf(value) + sum(mpmath.mpf(h) * _mp(a) * slopes[j][i] for j, a in enumerate(row))
                    for i, value in enumerate(point.x)
                ]
                at = Point(mpmath.mpf(point.t) + _mp(c) * h, x, point.condition, point.inputs, point.constants)  # type: ignore[arg-type]
                rate = self.rhs(at)
                if isinstance(method, RosenbrockW):
                    n = len(rate)
                    summed = [sum(_mp(g) * slopes[j][i] for j, g in enumerate(method.g[stage])) for i in range(n)]
                    right = mpmath.matrix(rate) + matrix * mpmath.matrix(summed)
                    rate = list(mpmath.lu_solve(mpmath.eye(n) - _mp(method.gamma) * matrix, right))
                slopes.append(rate)
            return [
                mpmath.mpf(value) + sum(mpmath.mpf(h) * _mp(b) * slopes[j][i] for j, b in enumerate(method.b))
                for i, value in enumerate(point.x)
            ]

    def slopes(self, point: Point) -> Any:
        """The Jacobian of the right-hand side, by differences at 30 digits."""
        n, found = len(point.x), mpmath.zeros(len(point.x))
        for j in range(n):
            size = mpmath.mpf(10) ** -9 * max(1, abs(point.x[j]))
            ends = []
            for sign in (1, -1):
                x = [mpmath.mpf(value) + (sign * size if i == j else 0) for i, value in enumerate(point.x)]
                ends.append(self.rhs(Point(point.t, x, point.condition, point.inputs, point.constants)))  # type: ignore[arg-type]
            for i in range(n):
                found[i, j] = (ends[0][i] - ends[1][i]) / (2 * size)
        return found

    def _evaluate(self, expressions: Sequence[Expr], point: Point) -> list[Any]:
        model = self.model
        external = [*model.conditions, *model.inputs, *model.delays]
        names = [model.time, *model.states, *external, *model.constants, *model.learnables]
        values = [point.t, *point.x, *point.condition, *point.inputs, *point.constants]
        self.table = {
            item.symbol: mpmath.mpf(value)
            for item, value in zip((*model.constants, *model.learnables), point.constants, strict=True)
        }
        with mpmath.workdps(30):
            table = {item.symbol: mpmath.mpf(value) for item, value in zip(names, values, strict=True)}
            for item in model.intermediates:
                table[item.symbol] = value_of(item.value, table, self.unknowns)
            return [value_of(expression, table, self.unknowns) for expression in expressions]

    def _unknown(self, unknown: Any) -> Callable[..., Any]:
        network = self.model.networks[unknown.network]
        formals = [argument.symbol for argument in network.arguments]

        def free(*arguments: Any) -> Any:
            table = {**self.table, **dict(zip(formals, arguments, strict=True))}
            center, scale = (self._numbers(network, f"output_{word}")[unknown.output] for word in ("center", "scale"))
            table[NN] = center + scale * self._raw(network, arguments)[unknown.output]
            return value_of(unknown.postulate, table, {})

        def formed(*arguments: Any) -> Any:
            table = {**self.table, **dict(zip(formals, arguments, strict=True))}
            points = [[value_of(node, table, {}) for node in point] for point in unknown.form.evaluations]
            for symbol in unknown.form.value.free_symbols:
                match described(symbol.name):
                    case ("raw", (evaluation, output)):
                        table[symbol] = self._raw(network, points[evaluation])[output]
                    case ("input_scale", (place, *_)):
                        table[symbol] = self._numbers(network, "input_scale")[place]
                    case (word, (place, *_)):
                        table[symbol] = self._numbers(network, f"output_{word}")[place]
            return value_of(unknown.form.value, table, {})

        return free if unknown.form is None else formed

    def _numbers(self, network: Network, name: str) -> Any:
        return self.weights[f"network.{network.name}.{name}"]

    def _raw(self, network: Network, arguments: Sequence[Any]) -> list[Any]:
        """The outputs of the last layer."""
        if network.layout is not None:
            raise NotImplementedError("networks with directions are compared in tests/contracts")

        def numbers(name: str) -> Any:
            return self._numbers(network, name)

        a = (np.array(arguments, dtype=object) - numbers("input_center")) / numbers("input_scale")
        for layer in range(len(network.hidden) + 1):
            if layer:
                a = np.array([ACTIVATIONS[network.activation](z) for z in a], dtype=object)
            a = numbers(f"{layer}.weight").dot(a) + numbers(f"{layer}.bias")
        return list(a)


FUNCTIONS: Mapping[type[sympy.Basic], Callable[..., Any]] = {
    sympy.Add: lambda *a: sum(a, mpmath.mpf(0)),
    sympy.Mul: lambda *a: mpmath.fprod(a),
    sympy.Pow: mpmath.power,
    sympy.Max: max,
    sympy.Min: min,
    sympy.Abs: abs,
    sympy.log: mpmath.log,
    **{
        getattr(sympy, name): getattr(mpmath, name)
        for name in ["exp", "sin", "cos", "tan", "cot", "sec", "csc", "sinh", "cosh", "tanh"]
    },
    **{
        getattr(sympy, name): getattr(mpmath, name)
        for name in ["asin", "acos", "atan", "asinh", "acosh", "atanh", "atan2", "sign", "floor"]
    },
    softplus: lambda a: mpmath.log(1 + mpmath.exp(a)),
    logistic: lambda a: 1 / (1 + mpmath.exp(-a)),
    sympy.StrictLessThan: lambda a, b: a < b,
    sympy.LessThan: lambda a, b: a <= b,
    sympy.StrictGreaterThan: lambda a, b: a > b,
    sympy.GreaterThan: lambda a, b: a >= b,
    sympy.Equality: lambda a, b: a == b,
    sympy.Unequality: lambda a, b: a != b,
    sympy.And: lambda *a: all(a),
    sympy.Or: lambda *a: any(a),
    sympy.Not: lambda a: not a,
    sympy.ITE: lambda c, a, b: a if c else b,
}
"""Functions from the values of a node's arguments to its value, at mpmath's precision."""


def value_of(node: Any, table: Mapping[Any, Any], unknowns: Mapping[str, Callable[..., Any]]) -> Any:
    """The value of an expression or condition; only the branch that is taken is evaluated."""
    if node in table:
        return table[node]
    match node:
        case sympy.Float() | sympy.Integer():
            return mpmath.mpf(float(node))
        case sympy.Rational():
            return _mp(node)
        case sympy.NumberSymbol():
            return {sympy.pi: mpmath.pi, sympy.E: mpmath.e}[node] + 0
        case sympy.logic.boolalg.BooleanAtom():
            return bool(node)
        case sympy.Piecewise():
            taken = next(value for value, condition in node.args if value_of(condition, table, unknowns))
            return value_of(taken, table, unknowns)
    arguments = [value_of(argument, table, unknowns) for argument in node.args]
    if isinstance(node, sympy.core.function.AppliedUndef):
        return unknowns[node.func.__name__](*arguments)
    if isinstance(node, Lookup):  # at 16 digits; tests/tables compare its values with those of scipy
        return mpmath.mpf(float(node.curve.value(node.order, *map(float, arguments))))
    return FUNCTIONS[type(node)](*arguments)


def _mp(fraction: Any) -> Any:
    return mpmath.mpf(int(fraction.numerator)) / int(fraction.denominator)
