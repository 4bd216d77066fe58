"""The algebraic equations of a model as methods of the generated class."""

from __future__ import annotations

import json
import math

from sympy.core.function import AppliedUndef

from gbspec.backends.module.equations import PARAMETERS, body_of, scope
from gbspec.backends.module.writing import comma, left_side, method_text
from gbspec.backends.printing import Assignment, temporary
from gbspec.ir import Algebraic, EquationBlock, Expr, Model, derivative, symbol


def methods(model: Model) -> list[str]:
    """`blocks`, a method for the residuals of each of them, and `algebraic`, in models with algebraic variables."""
    if not model.algebraics:
        return []
    blocks = [block for block in model.blocks if not block.explicit]
    variables = {item.name: item for item in model.algebraics}
    lines, own, known = ["blocks: ClassVar[tuple[tuple[Any, ...], ...]] = ("], [], list[str]()
    for i, block in enumerate(blocks):
        system = _System(model, block, known)
        listed = comma(json.dumps(name, ensure_ascii=False) for name in block.equations)
        derived = f"linear_{i}" if system.slopes else ""
        lines += [f'    ("residual_{i}", "{derived}", ({listed}), (']
        lines += [f"        ({_variable(variables[name])})," for name in block.variables]
        lines += ["    )),"]
        own.append(system.method(f"residual_{i}", with_slopes=False))
        own += [system.method(f"linear_{i}", with_slopes=True)] if system.slopes else []
        known += block.variables
    found = ["\n".join([*lines, ")"]), *own]
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


class _System:
    """The equations of a block, with variables of earlier blocks known."""

    def __init__(self, model: Model, block: EquationBlock, known: list[str]) -> None:
        self._model, self._block = model, block
        self._names = [*known, *block.variables]
        table = {equation.name: equation for equation in model.constraints}
        self._values = model.inlined([table[equation].residual for equation in block.equations])
        sought = [symbol(name) for name in block.variables]
        self.slopes: list[Expr] = []
        """Their derivatives by the variables, row by row; empty where they contain unknown functions."""
        if not any(value.has(AppliedUndef) for value in self._values):
            self.slopes = [derivative(value, variable) for value in self._values for variable in sought]

    def method(self, name: str, *, with_slopes: bool) -> str:
        """The method that gives the residuals, and with them their derivatives."""
        model, names = self._model, scope(self._model, "solved")
        outputs = [
            Assignment(temporary(f"residual{i}"), value, f"left_of_{equation}")
            for i, (equation, value) in enumerate(zip(self._block.equations, self._values, strict=True))
        ]
        left, slopes = (
            list(outputs),
            [Assignment(temporary(f"slope{i}"), value, f"slope{i}") for i, value in enumerate(self.slopes)],
        )
        outputs += slopes if with_slopes else []
        used = {free for output in outputs for free in output.value.free_symbols}
        wanted = [names[symbol(item)] if symbol(item) in used else "_" for item in self._names]
        lines = [f"{left_side(wanted)} = solved"]
        lines += body_of(model, outputs, names, solved=False)
        packed = f"math.pack(state, ({comma(names[output.symbol] for output in left)}))"
        document = f"What is left of {', '.join(self._block.equations)}, for {', '.join(self._block.variables)}"
        if with_slopes:
            packed += f", math.pack(state, ({comma(names[output.symbol] for output in slopes)}))"
            document += "; and its derivatives by these, row by row"
        parameters = ["cls", "math", names[model.time.symbol], *PARAMETERS[1:], "solved"]
        return method_text("@classmethod", name, parameters, f"{document}.", [*lines, f"return {packed}"])
