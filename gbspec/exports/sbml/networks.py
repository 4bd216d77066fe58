"""Applications of networks as quantities with formulas: one for each unit, in numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import sympy

from gbspec.backends import Call, NotCoveredError, Operation, flatten
from gbspec.exports.programs import MOST_CALLS, MOST_OPERATIONS
from gbspec.exports.subject import Exported
from gbspec.ir import Expr

if TYPE_CHECKING:
    from gbspec.exports.sbml.formulas import Infix, Names

Steps = list[tuple[str, str]]
_ACTIVATIONS: dict[str, Callable[[str], str]] = {
    "silu": lambda x: f"({x})/(1 + exp(-({x})))",
    "tanh": lambda x: f"tanh({x})",
    "softplus": lambda x: f"max({x}, 0) + ln(1 + exp(-abs({x})))",
    "relu": lambda x: f"max({x}, 0)",
    "sigmoid": lambda x: f"1/(1 + exp(-({x})))",
    "elu": lambda x: f"piecewise({x}, {x} > 0, exp({x}) - 1)",
    "sin": lambda x: f"sin({x})",
}


class Applications:
    """The applications of a model's unknowns that were met."""

    def __init__(self, exported: Exported, names: Names) -> None:
        self._exported, self._names = exported, names
        self._made: dict[Expr, str] = {}

    def name_of(self, node: Expr) -> str | None:
        """The quantity that holds the value of an application."""
        return self._made.get(node)

    def steps(self, node: Expr, printer: Infix) -> tuple[str, Steps]:
        """A name for an application, and the quantities by which it is computed, itself the last."""
        model = self._exported.model
        flat = flatten(model, [node], MOST_OPERATIONS, MOST_CALLS)
        base = self._names.free(node.func.__name__ if not self._made else f"{node.func.__name__}_{len(self._made)}")
        known: dict[sympy.Symbol, sympy.Basic] = {}
        for symbol, leaf in flat.leaves.items():
            if leaf.kind == "number":
                known[symbol] = sympy.Float(self._exported.numbers[leaf.index])
        found: Steps = []

        def text(value: sympy.Basic) -> str:
            return printer.print(value.xreplace(known))

        for step in flat.steps:
            if not isinstance(step, Operation):
                outputs = self._network(step, [text(sympy.sympify(a)) for a in step.arguments], base, found)
                for symbol, name in zip(step.results, outputs, strict=False):
                    known[symbol] = sympy.Symbol(name, real=True)
            elif isinstance(step.value, sympy.logic.boolalg.Boolean):
                known[step.symbol] = step.value.xreplace(known)
            else:
                name = self._names.free(f"{base}_{len(found)}")
                found.append((name, text(step.value)))
                known[step.symbol] = sympy.Symbol(name, real=True)
        found.append((base, text(sympy.sympify(flat.outputs[0]))))
        self._made[node] = base
        return base, found

    def _network(self, step: Call, arguments: Sequence[str], base: str, found: Steps) -> list[str]:
        """The outputs of a network at arguments."""
        network = self._exported.model.networks[step.network]
        numbers = self._exported.networks[step.network]
        if network.spline or network.activation not in _ACTIVATIONS or network.layout is not None:
            raise NotCoveredError("it has a spline or a network with bounded weights, which is not offered in SBML")
        x = [
            f"(({a}) - ({float(c)!r}))/({float(s)!r})"
            for a, c, s in zip(arguments, numbers.input_center, numbers.input_scale, strict=True)
        ]
        for layer, (weight, bias) in enumerate(numbers.layers):
            last = layer == len(numbers.layers) - 1
            values = [
                " + ".join([*(f"({float(w)!r})*({v})" for w, v in zip(row, x, strict=True)), f"({float(b)!r})"])
                for row, b in zip(weight, bias, strict=True)
            ]
            if last and not numbers.raw:
                rows = zip(values, numbers.output_scale, numbers.output_center, strict=True)
                values = [f"({float(c)!r}) + ({float(s)!r})*({v})" for v, s, c in rows]
            x = []
            for i, value in enumerate(values):
                sums = self._names.free(f"{base}_{layer + 1}_{i + 1}")
                found.append((sums, value))
                if last:
                    x.append(sums)
                    continue
                unit = self._names.free(f"{sums}_out")
                found.append((unit, _ACTIVATIONS[network.activation](sums)))
                x.append(unit)
        return x
