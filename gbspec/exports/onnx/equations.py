"""Lists of operations as nodes of a graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import sympy
from sympy.core.relational import Relational
from sympy.logic.boolalg import BooleanAtom

from gbspec.backends import UNARY, Call, Flat, Guard, Leaf, NotCoveredError, Operation, Where, activation_parts
from gbspec.exports.onnx.graph import Graph
from gbspec.exports.onnx.lookups import lookup
from gbspec.exports.onnx.operators import Operators
from gbspec.exports.subject import Exported
from gbspec.ir import Lookup, ordered

MOST_PRODUCTS = 4
"""Integer powers up to this exponent are products."""


class Equations:
    """Adds the operations of flattened functions to a graph."""

    def __init__(self, graph: Graph, exported: Exported) -> None:
        self.graph, self.exported, self.operators = graph, exported, Operators(graph)

    def add(self, flat: Flat, place: Callable[[Leaf], str]) -> list[str]:
        """The values of a function's outputs; `place` is the value of a leaf."""
        values: dict[sympy.Basic, str] = {}
        for symbol, leaf in flat.leaves.items():
            if leaf.kind == "number":
                values[symbol] = self.graph.number(self.exported.numbers[leaf.index])
            else:
                values[symbol] = place(leaf)
        for step in flat.steps:
            if isinstance(step, Operation):
                values[step.symbol] = self._operation(step.value, values)
            else:
                values.update(zip(step.results, self._call(step, values), strict=True))
        return [self._of(output, values) for output in flat.outputs]

    def _of(self, node: sympy.Basic, values: dict[sympy.Basic, str]) -> str:
        """The value of an argument: that of its symbol, or a number."""
        if node in values:
            return values[node]
        if not node.free_symbols and isinstance(node, sympy.Expr):
            return self.graph.number(float(node))
        return self._operation(node, values)

    def _operation(self, node: sympy.Basic, values: dict[sympy.Basic, str]) -> str:
        g, ops = self.graph, self.operators
        arguments = [self._of(argument, values) for argument in node.args] if not isinstance(node, BooleanAtom) else []
        match node:
            case Guard():
                return arguments[1]
            case Where():
                return g.op("Where", *arguments)
            case sympy.Add():
                return self._folded("Add", arguments)
            case sympy.Mul():
                return self._product(node, values)
            case sympy.Pow():
                return self._power(node, arguments)
            case sympy.Max() | sympy.Min():
                word = "Max" if isinstance(node, sympy.Max) else "Min"
                return self._folded(word, [self._of(a, values) for a in ordered(node)])
            case sympy.atan2():
                return ops.apply("atan2", *arguments)
            case Lookup():
                return lookup(g, ops, node, arguments)
            case BooleanAtom() | Relational() | sympy.And() | sympy.Or() | sympy.Not() | sympy.ITE():
                return self._condition(node, arguments)
        if type(node) in UNARY:
            return ops.apply(UNARY[type(node)], *arguments)
        raise NotCoveredError(f"no operator of ONNX expresses `{type(node).__name__}`")

    def _folded(self, kind: str, arguments: Sequence[str]) -> str:
        first, *rest = arguments
        for argument in rest:
            first = self.graph.op(kind, first, argument)
        return first

    def _product(self, node: sympy.Mul, values: dict[sympy.Basic, str]) -> str:
        if node.args[0] == -1 and len(node.args) == 2:
            return self.graph.op("Neg", self._of(node.args[1], values))
        return self._folded("Mul", [self._of(argument, values) for argument in node.args])

    def _power(self, node: sympy.Pow, arguments: Sequence[str]) -> str:
        exponent = node.args[1]
        if exponent == -1:
            return self.operators.div(1.0, arguments[0])
        if exponent == sympy.Rational(1, 2):
            return self.graph.op("Sqrt", arguments[0])
        if exponent.is_Integer and 1 < exponent <= MOST_PRODUCTS:
            return self._folded("Mul", [arguments[0]] * int(exponent))
        return self.graph.op("Pow", *arguments)

    def _condition(self, node: sympy.Basic, arguments: Sequence[str]) -> str:
        g = self.graph
        match node:
            case Relational():
                words = {"<": "Less", "<=": "LessOrEqual", ">": "Greater", ">=": "GreaterOrEqual", "==": "Equal"}
                if node.rel_op == "!=":
                    return g.op("Not", g.op("Equal", *arguments))
                return g.op(words[node.rel_op], *arguments)
            case sympy.Not():
                return g.op("Not", *arguments)
            case sympy.And() | sympy.Or():
                return self._folded("And" if isinstance(node, sympy.And) else "Or", arguments)
            case sympy.ITE():
                condition, then, otherwise = arguments
                return g.op("Or", g.op("And", condition, then), g.op("And", g.op("Not", condition), otherwise))
        zero, one = g.number(0.0), g.number(1.0)
        return g.op("Less", *((zero, one) if node == sympy.true else (one, zero)))

    # -------------------------------------------------------------- networks
    def _call(self, call: Call, values: dict[sympy.Basic, str]) -> list[str]:
        """All outputs of a network."""
        g, ops, index = self.graph, self.operators, call.network
        network, numbers = self.exported.model.networks[index], self.exported.networks[index]
        points = g.joined([self._of(argument, values) for argument in call.arguments])
        prefix = f"network_{index}"
        center = g.tensor(f"{prefix}_center", numbers.input_center[None, :])
        z = ops.div(ops.sub(points, center), g.tensor(f"{prefix}_scale", numbers.input_scale[None, :]))
        for i, (weight, bias) in enumerate(numbers.layers):
            z = g.op("Gemm", z, g.tensor(f"{prefix}_weight_{i}", weight.T), g.tensor(f"{prefix}_bias_{i}", bias))
            if i < len(network.hidden):
                z = self._activated(activation_parts(network, i), z)
        if not numbers.raw:
            z = ops.mul(z, g.tensor(f"{prefix}_out_scale", numbers.output_scale[None, :]))
            z = ops.add(z, g.tensor(f"{prefix}_out_center", numbers.output_center[None, :]))
        return g.columns(z, network.sizes[-1])

    def _activated(self, parts: Sequence[tuple[str, int]], z: str) -> str:
        if len(parts) == 1:
            return self.operators.activation(parts[0][0], z)
        pieces = self.graph.blocks(z, [count for _, count in parts])
        done = [self.operators.activation(kind, piece) for (kind, _), piece in zip(parts, pieces, strict=True)]
        return self.graph.op("Concat", *done, axis=1)
