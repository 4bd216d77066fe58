"""The algebraic equations of a model as methods of the generated class."""

from __future__ import annotations

import json
import math

from gbspec.backends.module.equations import PARAMETERS, body_of, scope
from gbspec.backends.module.writing import comma, left_side, method_text
from gbspec.backends.printing import Assignment, Vectors, temporary
from gbspec.ir import Algebraic, EquationBlock, Model


def methods(model: Model) -> list[str]:
    """`blocks`, a method for the residuals of each of them, and `algebraic`, in models with algebraic variables."""
    if not model.algebraics:
        return []
    blocks = [block for block in model.blocks if not block.explicit]
    variables = {item.name: item for item in model.algebraics}
    lines = [
        "blocks: ClassVar[tuple[tuple[str, tuple[str, ...], tuple[tuple[str, float, float, float], ...]], ...]] = ("
    ]
    for i, block in enumerate(blocks):
        listed = comma(json.dumps(name, ensure_ascii=False) for name in block.equations)
        lines += [f'    ("residual_{i}", ({listed}), (']
        lines += [f"        ({_variable(variables[name])})," for name in block.variables]
        lines += ["    )),"]
    found = ["\n".join([*lines, ")"])]
    known: list[str] = []
    for i, block in enumerate(blocks):
        found.append(_residual(model, f"residual_{i}", block, known))
        known += block.variables
    time = scope(model)[model.time.symbol]
    names = ["math", time, *PARAMETERS[1:]]
    document = f"The algebraic variables: {', '.join(variables)}."
    given = f"(cls, math, ({', '.join(names[1:])}))"
    about = "Which equations have no solution at a single point; empty where all have one."
    return [
        *found,
        method_text("@classmethod", "algebraic", ["cls", *names], document, [f"return _solved{given}"]),
        method_text("@classmethod", "unsolved", ["cls", *names], about, [f"return _unsolved{given}"]),
    ]


def start_of(item: Algebraic) -> float:
    """Where the search for a variable's solution begins: as declared, else in the middle of its range, else near 1."""
    if item.start is not None:
        return item.start
    low, high = (-math.inf, math.inf) if item.range is None else (item.range.low, item.range.high)
    if math.isfinite(low) and math.isfinite(high):
        return 0.5 * (low + high)
    if math.isfinite(low) or math.isfinite(high):
        end, way = (low, 1.0) if math.isfinite(low) else (high, -1.0)
        return end + way * max(1.0, abs(end))
    return 1.0


def _variable(item: Algebraic) -> str:
    low, high = (-math.inf, math.inf) if item.range is None else (item.range.low, item.range.high)
    ends = (f"{'-' if end < 0 else ''}np.inf" if math.isinf(end) else repr(end) for end in (low, high))
    return f"{json.dumps(item.name, ensure_ascii=False)}, {start_of(item)!r}, {', '.join(ends)}"


def _residual(model: Model, name: str, block: EquationBlock, known: list[str]) -> str:
    """The method that gives the residuals of a block; `known` are the variables of earlier blocks."""
    names = scope(model, "solved")
    table = {equation.name: equation for equation in model.constraints}
    values = model.inlined([table[equation].residual for equation in block.equations])
    outputs = [
        Assignment(temporary(f"residual{i}"), value, f"left_of_{equation}")
        for i, (equation, value) in enumerate(zip(block.equations, values, strict=True))
    ]
    definitions = None
    if model.arrays:
        vectors = Vectors(model)
        definitions = [*vectors.definitions, *vectors.entries(outputs)]
    symbols = {item.name: item.symbol for item in model.algebraics}
    used = {symbol for value in values for symbol in value.free_symbols}
    wanted = [names[symbols[item]] if symbols[item] in used else "_" for item in (*known, *block.variables)]
    lines = [f"{left_side(wanted)} = solved"]
    lines += body_of(model, outputs, names, definitions=definitions, solved=False)
    lines.append(f"return math.pack(state, ({comma(names[output.symbol] for output in outputs)}))")
    parameters = ["cls", "math", names[model.time.symbol], *PARAMETERS[1:], "solved"]
    document = f"What is left of {', '.join(block.equations)}, for {', '.join(block.variables)}."
    return method_text("@classmethod", name, parameters, document, lines)
