"""Compares graphs with the generated module: by onnxruntime, or else by the evaluator of the package onnx."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx

from gbspec.arrays import Array
from gbspec.exports.checking import Points, Quantity, Reference, compare, draw
from gbspec.exports.made import Precision
from gbspec.exports.programs import Programs
from gbspec.exports.subject import Exported
from gbspec.ir import Unknown

ACCEPTED = {"float64": 1e-11, "float32": 1e-5}
POINTS = 8
STEP = 0.01


def verify(
    exported: Exported,
    programs: Programs,
    graphs: Mapping[str, bytes],
    unknowns: Mapping[str, Unknown | None],
    precision: Precision,
) -> list[Quantity]:
    """The largest errors of graphs by name, at random points and in a step; `unknowns` has those of functions."""
    points = draw(exported, POINTS, spread=0.0)
    known = Reference(exported, programs, points)
    found = []
    for part, data in graphs.items():
        unknown = unknowns[part]
        if unknown is not None:
            arguments = _arguments(exported, unknown)
            value = known.unknown(unknown.name, list(arguments.T))[:, None]
            own = {"arguments": arguments, "constants": exported.constants[None, :]}
            values, pair, name = run(data, own), (value, np.abs(value) + 1.0), f"the function {unknown.name}"
        elif part == "rhs":
            values, pair, name = run(data, feeds(exported, points)), known.rhs, "the right-hand side"
        elif part == "observe":
            values, pair, name = run(data, feeds(exported, points)), known.observe, "the channels"
        elif part == "lags":
            values, pair, name = run(data, feeds(exported, points)), known.lags, "the delays"
        elif part == "delayed":
            values, pair, name = run(data, feeds(exported, points, delayed=False)), known.delayed, "what is delayed"
        else:
            h = known.sizes_of_steps(exported.step or STEP)
            values, pair, name = run(data, step_feeds(exported, points, h)), known.step(h), "a step"
        found.append(compare(name, values, pair, ACCEPTED[precision]))
    return found


def _arguments(exported: Exported, unknown: Unknown) -> Array:
    """Arguments of a function within the ranges that it learned from, else around its center."""
    numbers = exported.networks[unknown.network]
    low = np.where(np.isfinite(numbers.low), numbers.low, numbers.input_center - numbers.input_scale)
    high = np.where(np.isfinite(numbers.high), numbers.high, numbers.input_center + numbers.input_scale)
    return np.asarray(low + (high - low) * np.random.default_rng(1).random((POINTS, len(low))))


def feeds(exported: Exported, points: Points, *, delayed: bool = True) -> dict[str, Array]:
    """The inputs of a graph of values, with delayed values behind them; constants are the exported ones."""
    inputs = points.inputs if delayed else points.inputs[:, : len(exported.model.inputs)]
    given = {"t": points.t, "x": points.x, "condition": points.condition, "inputs": inputs}
    return {**given, "constants": exported.constants[None, :]}


def step_feeds(exported: Exported, points: Points, h: Array) -> dict[str, Array]:
    """Those of a step, with the same inputs at all nodes."""
    nodes = dict.fromkeys(exported.method.input_names, points.inputs)
    return {**feeds(exported, points), "h": h, **nodes}


def run(data: bytes, given: Mapping[str, Array]) -> Array:
    """The output of a graph; inputs that it has not are left out."""
    model = onnx.load_from_string(data)
    dtype = np.float64 if model.graph.output[0].type.tensor_type.elem_type == onnx.TensorProto.DOUBLE else np.float32
    names = {one.name for one in model.graph.input}
    fed = {name: np.ascontiguousarray(value, dtype=dtype) for name, value in given.items() if name in names}
    try:
        import onnxruntime
    except ImportError:
        from onnx.reference import ReferenceEvaluator

        with np.errstate(all="ignore"):
            (found,) = ReferenceEvaluator(model).run(None, fed)
            return np.asarray(found, dtype=np.float64)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, fed)[0], dtype=np.float64)
