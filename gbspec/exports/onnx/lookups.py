"""Tables in ONNX's operators: comparisons with all places mark the piece, and products with the marks choose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.exports.onnx.graph import Graph
from gbspec.exports.onnx.operators import Operators
from gbspec.ir import Lookup


def lookup(graph: Graph, ops: Operators, node: Lookup, arguments: Sequence[str]) -> str:
    """The value of a table, or of a derivative, at columns [batch, 1]."""
    curve, strict = node.curve, node.curve.outside == "error" and not any(node.order)
    name = f"table_{curve.digest[:12]}_{'_'.join(map(str, node.order))}"
    marks, steps, flat = [], [], []
    for i, (x, knots) in enumerate(zip(arguments, curve.knots, strict=True)):
        inside = graph.op("Min", graph.op("Max", x, graph.number(knots[0])), graph.number(knots[-1]))
        # The last piece has no upper end, so that the last place belongs to it; every x inside is above the first.
        lows = graph.tensor(f"{name}_low_{i}", np.array(knots[:-1])[None, :])
        highs = graph.tensor(f"{name}_high_{i}", np.array([*knots[1:-1], np.inf])[None, :])
        above = [
            graph.op("Cast", graph.op("GreaterOrEqual", inside, ends), to=int(graph.type)) for ends in (lows, highs)
        ]
        mark = graph.op("Sub", *above)
        marks.append(mark)
        low = graph.op("MatMul", mark, graph.tensor(f"{name}_place_{i}", np.array(knots[:-1])[:, None]))
        steps.append(graph.op("Sub", inside, low))
        if strict or node.order[i]:
            flat += [ops.less(x, knots[0]), ops.less(graph.number(knots[-1]), x)]
    value = _polynomial(graph, ops, name, curve.derived(node.order), marks, steps)
    for beyond in flat:
        value = ops.where(beyond, np.nan if strict else 0.0, value)
    return value


def _polynomial(
    graph: Graph, ops: Operators, name: str, found: np.ndarray, marks: Sequence[str], steps: Sequence[str]
) -> str:
    """The polynomial of the marked piece, by Horner's rule in each argument."""
    if len(marks) == 1:
        terms = [_chosen(graph, f"{name}_c{a}", found[:, a], marks) for a in range(found.shape[1])]
        return _horner(ops, terms, steps[0])
    rows = [
        _horner(
            ops, [_chosen(graph, f"{name}_c{a}_{b}", found[..., a, b], marks) for b in range(found.shape[3])], steps[1]
        )
        for a in range(found.shape[2])
    ]
    return _horner(ops, rows, steps[0])


def _chosen(graph: Graph, name: str, values: np.ndarray, marks: Sequence[str]) -> str:
    """The coefficient of the marked piece."""
    table = values[:, None] if values.ndim == 1 else values
    row = graph.op("MatMul", marks[0], graph.tensor(name, table))
    if values.ndim == 1:
        return row
    return graph.op("ReduceSum", graph.op("Mul", row, marks[1]), graph.axis(), keepdims=1)


def _horner(ops: Operators, terms: Sequence[str], step: str) -> str:
    """The sum of terms times powers of the step, lowest power first."""
    total = terms[-1]
    for term in reversed(terms[:-1]):
        total = ops.add(ops.mul(total, step), term)
    return total
