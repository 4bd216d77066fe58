"""A graph under construction: nodes, numbers, inputs and outputs.

Every scalar of the model is a column: [batch, 1], or [1, 1] where it is the same for all points of a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from gbspec.arrays import Array
from gbspec.exports.made import Precision

OPSET, IR_VERSION = 17, 8
"""Of 2022: what is asked for here has not changed since, and older runtimes read it."""


class Graph:
    """Collects the nodes of one graph; names of values are strings."""

    def __init__(self, name: str, precision: Precision) -> None:
        self.name, self.precision = name, precision
        self.dtype = np.dtype(precision)
        self.type = TensorProto.DOUBLE if precision == "float64" else TensorProto.FLOAT
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: dict[str, onnx.TensorProto] = {}
        self.inputs: list[onnx.ValueInfoProto] = []
        self.outputs: list[onnx.ValueInfoProto] = []
        self.batched: set[str] = set()
        self._numbers: dict[float, str] = {}
        self._known: dict[tuple[object, ...], str] = {}
        self._like, self._count = "", 0

    # -------------------------------------------------------------- inputs and outputs
    def input(self, name: str, width: int | None) -> str:
        """An input [batch, width], or [batch]."""
        shape: list[str | int | None] = ["batch"] if width is None else ["batch", width]
        self.inputs.append(helper.make_tensor_value_info(name, self.type, shape))
        self.batched.add(name)
        self._like = self._like or name
        return name

    def columns(self, name: str, width: int) -> list[str]:
        """The columns of a matrix."""
        if width == 1:
            return [name]
        return self.blocks(name, [1] * width)

    def output(self, name: str, columns: Sequence[str]) -> None:
        """An output [batch, columns]."""
        joined = self.joined(columns)
        self.nodes.append(helper.make_node("Identity", [joined], [name]))
        self.outputs.append(helper.make_tensor_value_info(name, self.type, ["batch", len(columns)]))

    def joined(self, columns: Sequence[str]) -> str:
        """Columns side by side, in the batch of the first input."""
        whole = [column if column in self.batched else self._expanded(column) for column in columns]
        return whole[0] if len(whole) == 1 else self.op("Concat", *whole, axis=1)

    def _expanded(self, column: str) -> str:
        """A column that is the same for all points, repeated."""
        count = self.op("Shape", self._like, start=0, end=1)
        shape = self.op("Concat", count, self.axis(), axis=0)
        found = self.op("Expand", column, shape)
        self.batched.add(found)
        return found

    # -------------------------------------------------------------- values
    def op(self, kind: str, *inputs: str, **attributes: int | float) -> str:
        """The value of an operator; the same operator of the same values is computed once."""
        key = (kind, inputs, tuple(sorted(attributes.items())))
        if key not in self._known:
            name = self._fresh()
            self.nodes.append(helper.make_node(kind, list(inputs), [name], None, None, None, None, **attributes))
            if self.batched.intersection(inputs):
                self.batched.add(name)
            self._known[key] = name
        return self._known[key]

    def number(self, value: float) -> str:
        """A number, [1, 1]."""
        if value not in self._numbers:
            self._numbers[value] = self.tensor(f"number_{len(self._numbers)}", np.array([[value]], dtype=self.dtype))
        return self._numbers[value]

    def tensor(self, name: str, values: Array | np.ndarray) -> str:
        """A constant tensor, of the graph's precision where it is not of integers."""
        array = np.ascontiguousarray(values if values.dtype.kind == "i" else values.astype(self.dtype))
        self.initializers.setdefault(name, numpy_helper.from_array(array, name))
        return name

    def axis(self) -> str:
        """The number of the second axis."""
        return self.tensor("one", np.array([1], dtype=np.int64))

    def blocks(self, name: str, counts: Sequence[int]) -> list[str]:
        """Neighbouring columns, that many in each part."""
        sizes = self.tensor(f"sizes_{'_'.join(map(str, counts))}", np.array(counts, dtype=np.int64))
        found = [self._fresh() for _ in counts]
        self.nodes.append(helper.make_node("Split", [name, sizes], found, axis=1))
        if name in self.batched:
            self.batched.update(found)
        return found

    def optional(self, name: str, values: Array) -> str:
        """An input [1, width] that has a default."""
        self.tensor(name, np.asarray(values)[None, :])
        self.inputs.append(helper.make_tensor_value_info(name, self.type, [1, len(values)]))
        return name

    def _fresh(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def _needed(self) -> tuple[list[onnx.NodeProto], set[str]]:
        """The nodes that the outputs need, in order, and the names of all values that these use."""
        used = {one.name for one in self.outputs}
        kept = []
        for node in reversed(self.nodes):
            if used.intersection(node.output):
                used.update(node.input)
                kept.append(node)
        return kept[::-1], used

    def bytes(self, metadata: Mapping[str, str], described: str) -> bytes:
        """The model file."""
        nodes, used = self._needed()
        kept = [tensor for name, tensor in self.initializers.items() if name in used]
        inputs = [one for one in self.inputs if one.name in used or one.name not in self.initializers]
        graph = helper.make_graph(nodes, self.name, inputs, self.outputs, kept, doc_string=described)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        model.producer_name, model.producer_version = "gbspec", metadata["gbspec"]
        model.doc_string = described
        helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model)
        data: bytes = model.SerializeToString()
        return data
