"""Regions that trajectories must not enter: conditions such as `x2 > 4`, evaluated along a solution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from numpy.typing import ArrayLike

from gbspec.arrays import Array
from gbspec.diagnostics import Findings, Source
from gbspec.ir import Model

CONDITIONS = (sympy.core.relational.Relational, sympy.logic.boolalg.BooleanFunction, sympy.logic.boolalg.BooleanAtom)
"""The types of conditions in sympy (except symbols, which sympy counts as conditions)."""


@dataclass(frozen=True)
class Region:
    """The region in which a user's condition holds; `text` is its source."""

    text: str
    holds: Callable[..., ArrayLike]

    def entered(self, times: Array, states: Array, condition: Array, inputs: Array, constants: Array) -> bool:
        """Whether it holds at any of the points: times [T], states [T, n], inputs [T, m]; a NaN is not inside."""
        with np.errstate(all="ignore"):
            inside = self.holds(times, *states.T, *condition, *inputs.T, *constants)
        return bool(np.any(inside))


def regions(texts: Sequence[str], model: Model, findings: Findings) -> tuple[Region, ...]:
    """Parses conditions on the model's time, states, conditions, inputs and constants; errors go to `findings`."""
    from gbspec.lower import lower_expression
    from gbspec.syntax import ast, parse_expression, walk

    names = (
        model.time,
        *model.states,
        *model.conditions,
        *model.inputs,
        *model.constants,
        *model.learnables,
    )
    found = []
    for text in texts:
        own = Findings()
        parsed = parse_expression(Source("--reject", text), own)
        for part in () if parsed is None else walk(parsed):
            if isinstance(part, ast.Conversion):
                help = "write the number in the declared unit"
                own.error("GB789", "a quantity cannot be given in a unit on the command line", part.span, help=help)
        lowered = None if parsed is None or own.failed else lower_expression(parsed, model, own)
        findings.extend(own)
        if lowered is None or own.failed:
            continue
        if not isinstance(lowered, CONDITIONS):
            findings.error(
                "GB755",
                f'`--reject "{text}"` is a number, not a condition',
                None,
                help='compare it with something, as in `--reject "x2 > 4"`',
            )
            continue
        (expanded,) = model.inlined((lowered,))
        arguments = [item.symbol for item in names]
        found.append(Region(text, sympy.lambdify(arguments, expanded, modules="numpy", dummify=True)))
    return tuple(found)
