"""The form `onnx`: graphs of the right-hand side, the channels, one step, and each learned function."""

from __future__ import annotations

from collections.abc import Callable

from gbspec.backends import Flat, Leaf
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.exports.checking import require
from gbspec.exports.made import ExportOptions, Made, record
from gbspec.exports.onnx.equations import Equations
from gbspec.exports.onnx.graph import Graph
from gbspec.exports.onnx.verifying import verify
from gbspec.exports.programs import Programs
from gbspec.exports.subject import Exported
from gbspec.ir import Model, Unknown

OF_DELAYS = ("delayed", "lags")
"""What is delayed, at its own time, and for how long; both are looked up by whoever keeps the past."""
OWN = ("rhs", "observe", "step", *OF_DELAYS)


def parts(model: Model) -> dict[str, Unknown | None]:
    """The graphs of a model by name; those of learned functions with the unknown."""
    found: dict[str, Unknown | None] = {"rhs": None, "observe": None, "step": None}
    if not model.channels:
        del found["observe"]
    found |= dict.fromkeys(OF_DELAYS) if model.delays else {}
    for unknown in model.unknowns:
        found[f"function_{unknown.name}" if unknown.name in OWN else unknown.name] = unknown
    return found


def make(exported: Exported, options: ExportOptions) -> Made:
    """The graphs, each compared with the generated module."""
    known = parts(exported.model)
    if options.part is not None and options.part not in known:
        message = f"the model `{exported.model.name}` has no graph `{options.part}`"
        raise UserError([Diagnostic("GB884", message, None, help=f"there are {', '.join(known)}")])
    chosen = known if options.part is None else {options.part: known[options.part]}
    writer = _Writer(exported, options)
    graphs = {part: writer.graph(part, unknown) for part, unknown in chosen.items()}
    checked = tuple(verify(exported, writer.programs, graphs, chosen, options.precision)) if options.verify else ()
    require("onnx", checked)
    files = {f"{part}.onnx": data for part, data in graphs.items()}
    if options.part is None:
        files |= {"model.gb": exported.model.text.encode(), "export.json": record(exported, "onnx")}
    return Made(files, checked)


class _Writer:
    """Makes the graphs of a model."""

    def __init__(self, exported: Exported, options: ExportOptions) -> None:
        self.exported, self.options, self.model = exported, options, exported.model
        self.programs = Programs(exported.model)

    def graph(self, part: str, unknown: Unknown | None) -> bytes:
        """The graph of a name, or of a learned function."""
        graph = Graph(part, self.options.precision)
        if unknown is not None:
            self._function(graph, unknown)
        elif part == "step":
            self._step(graph)
        else:
            self._values(graph, part)
        origin = {**self.exported.origin, "text": self.model.text}
        return graph.bytes(origin, f"{part} of {self.model.title or self.model.name}")

    def _values(self, graph: Graph, part: str) -> None:
        """`rhs`, `observe` or `delayed`: (t, x, condition, inputs, constants) -> values; delayed values stand behind
        the inputs of the first two. `lags`: (t, condition, constants) -> values; the batch is that of the times."""
        flat: Flat = getattr(self.programs, part)
        size = len(self.model.states)
        x = [] if part == "lags" else graph.columns(graph.input("x", size), size)
        t = self._time(graph)
        width = len(self.model.inputs) + (0 if part in OF_DELAYS else len(self.model.delays))
        place = self._place(graph, t, x, *(["inputs"] if width and part != "lags" else []), width=width)
        name = {"rhs": "dx", "observe": "y"}.get(part, part)
        graph.output(name, Equations(graph, self.exported).add(flat, place))

    def _time(self, graph: Graph) -> str:
        return graph.op("Unsqueeze", graph.input("t", None), graph.axis())

    def _place(self, graph: Graph, t: str, x: list[str], *inputs: str, width: int = 0) -> Callable[[Leaf], str]:
        """The values of leaves; the inputs of the graph are added for conditions, inputs and constants."""
        model, table = self.model, {"time": [t], "state": x}
        if model.conditions:
            table["condition"] = graph.columns(graph.input("condition", len(model.conditions)), len(model.conditions))
        if inputs:
            given = graph.columns(graph.input(inputs[0], width), width)
            table |= {"input": given, "delay": given[len(model.inputs) :]}
        if model.constant_names:
            constants = graph.optional("constants", self.exported.constants)
            table["constant"] = graph.columns(constants, len(model.constant_names))
        return lambda leaf: _known(table, leaf)

    def _function(self, graph: Graph, unknown: Unknown) -> None:
        """A learned function: (arguments, constants) -> value."""
        size = len(self.model.networks[unknown.network].arguments)
        columns = graph.columns(graph.input("arguments", size), size)
        table = {"state": columns}
        if self.model.constant_names:
            constants = graph.optional("constants", self.exported.constants)
            table["constant"] = graph.columns(constants, len(self.model.constant_names))
        flat = self.programs.unknown(unknown)
        equations = Equations(graph, self.exported)
        graph.output("value", equations.add(flat, lambda leaf: _known(table, leaf)))

    def _step(self, graph: Graph) -> None:
        """One step: (t, h, x, condition, inputs at the method's nodes, constants) -> x."""
        model, method = self.model, self.exported.method
        x = graph.columns(graph.input("x", len(model.states)), len(model.states))
        t, h = self._time(graph), graph.op("Unsqueeze", graph.input("h", None), graph.axis())
        base = self._place(graph, t, x)
        at_nodes, width = [], len(model.inputs) + len(model.delays)
        for name in method.input_names if width else ():
            at_nodes.append(graph.columns(graph.input(name, width), width))
        equations = Equations(graph, self.exported)
        ops, slopes = equations.operators, list[list[str]]()
        stages = method.advancing

        def ahead(weights: list[float]) -> list[str]:
            found = []
            for i, value in enumerate(x):
                terms = [ops.mul(k[i], w) for k, w in zip(slopes, weights, strict=False) if w]
                total = terms[0] if terms else ""
                for term in terms[1:]:
                    total = ops.add(total, term)
                found.append(ops.add(value, ops.mul(h, total)) if terms else value)
            return found

        for q in range(stages):
            place = ahead([float(a) for a in method.a[q]])
            time = ops.add(t, ops.mul(h, float(method.c[q]))) if method.c[q] else t
            given = at_nodes[method.nodes.index(method.c[q])] if at_nodes else []

            def leaf_of(leaf: Leaf, place: list[str] = place, time: str = time, given: list[str] = given) -> str:
                late = given[len(model.inputs) :]
                table = {"state": place, "time": [time], "input": given, "delay": late}
                return _known(table, leaf) if leaf.kind in table else base(leaf)

            slopes.append(equations.add(self.programs.rhs, leaf_of))
        graph.output("x_next", ahead([float(b) for b in method.b[:stages]]))


def _known(table: dict[str, list[str]], leaf: Leaf) -> str:
    """The value of a leaf; empty for one that the graph does not have: learned functions have no states."""
    return table[leaf.kind][leaf.index] if leaf.index < len(table.get(leaf.kind, ())) else ""
