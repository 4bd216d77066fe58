"""Times at which what depends on the time alone jumps: comparisons such as `mod(t, 24) < 8`, and `floor`.

A step across such a time is not as exact as the method, and one with error control may pass over a short interval
without noticing it. So steps end there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import sympy
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from gbspec.arrays import Array
from gbspec.ir.model import Expr, Model

MOST = 20_000
"""In an interval with more of these times no step ends at any of them."""
_JUMPING = (sympy.floor, sympy.sign, Relational)
_STRAIGHT = 1e-9
_CLOSE = 1e-11
_ROUNDING = 8

Quantities = tuple[tuple[Expr, bool], ...]


def may_jump(model: Model) -> bool:
    """Whether the times of jumps may depend on constants: those of events, and of doses with a lag."""
    return bool(model.events) or any(dose.lag.free_symbols for dose in model.doses)


def delayed_inputs(model: Model) -> tuple[int, ...]:
    """The indices of the inputs that are delayed, or of which something delayed is computed: when they change, what
    sees them does so a delay later."""
    found = {s for value in model.inlined(delay.value for delay in model.delays) for s in value.free_symbols}
    return tuple(i for i, one in enumerate(model.inputs) if one.symbol in found)


def scheduled(model: Model) -> Quantities:
    """What decides when right sides, and what they see of the past, jump, as far as it depends on the time, constants
    and conditions alone, the inner ones first: arguments of `floor` (True), and differences that are compared
    (False)."""
    known = {item.symbol for group in (model.constants, model.learnables, model.conditions) for item in group}
    found: dict[tuple[Expr, bool], int] = {}
    sides = (
        *model.balances,
        *(equation.residual for equation in model.constraints),
        *(delay.value for delay in model.delays),
        *(state.history for state in model.states if state.history is not None and model.delays),
    )
    if not any(value.has(*_JUMPING) for value in (*sides, *(item.value for item in model.intermediates))):
        return ()
    for value in model.inlined(sides):
        for node in value.atoms(*_JUMPING):
            compared = node.lhs - node.rhs if isinstance(node, Relational) else node.args[0]
            free = compared.free_symbols
            learned = compared.has(AppliedUndef)
            if model.time.symbol in free and free <= known | {model.time.symbol} and not learned:
                inner = len(compared.atoms(*_JUMPING))
                found[compared, isinstance(node, sympy.floor)] = inner
    return tuple(sorted(found, key=lambda each: (found[each], not each[1], sympy.default_sort_key(each[0]))))


Values = Callable[[Array], Sequence[Array]]
"""The values of quantities [n] at times [n]."""


def switching_times(values: Values, whole: Sequence[bool], begin: float, end: float) -> Array:
    """The times from `begin` to `end` at which one of some quantities passes a whole number (`whole`) or else 0.

    Only those that are straight lines between the jumps of earlier ones count, so that no such time is missed.
    """
    found, near = np.zeros(0), _CLOSE * (end - begin)
    for number, steps in enumerate(whole):
        edges = np.concatenate([[begin], found[(found > begin + near) & (found < end - near)], [end]])
        a, b = edges[:-1], edges[1:]
        at = np.concatenate([a + share * (b - a) for share in (0.25, 0.5, 0.75)])
        with np.errstate(all="ignore"):
            there = np.asarray(np.broadcast_to(values(at)[number], at.shape), dtype=np.float64)
            first, middle, last = there.reshape(3, -1)
            rise = 2 * (last - first)
            straight = np.abs(first + last - 2 * middle) <= _STRAIGHT * (np.abs(rise) + np.abs(middle))
        more = [found]
        for k in np.flatnonzero(straight & (rise != 0)):
            low, high = first[k] - rise[k] / 4, last[k] + rise[k] / 4
            levels = _between(low, high) if steps else np.zeros(1)
            times = a[k] + (levels - low) / rise[k] * (b[k] - a[k])
            more.append(times[(times >= a[k] - near) & (times <= b[k] + near)].clip(begin, end))
        found = np.unique(np.concatenate(more))
        found = found[np.diff(found, prepend=-np.inf) > near]
        if len(found) > MOST:
            return np.zeros(0)
    return found


def _between(low: float, high: float) -> Array:
    """The whole numbers in an interval, also those at its ends up to rounding."""
    near = _STRAIGHT * (1 + abs(high - low))
    first, last = np.ceil(min(low, high) - near), np.floor(max(low, high) + near)
    return np.arange(first, min(last, first + MOST) + 1)


def insets(edges: Array, switches: Array, tolerance: float) -> tuple[Array, Array]:
    """The increasing `edges` of steps, with those switching times that are none within a tolerance; and for each edge
    by how much steps stay away from it: a rounding error beside a switching time, so that no step is evaluated on its
    other side, else 0."""
    if not len(switches):
        return edges, np.zeros(len(edges))
    merged = np.unique(np.concatenate([edges, switches[_distance(switches, edges) > tolerance]]))
    distance = _distance(merged, switches)
    wanted = np.where(distance <= tolerance, distance + _ROUNDING * np.spacing(np.abs(merged).max()), 0.0)
    gaps = np.concatenate([[np.inf], np.diff(merged), [np.inf]])
    return merged, np.minimum(wanted, 0.25 * np.minimum(gaps[:-1], gaps[1:]))


def _distance(times: Array, places: Array) -> Array:
    """From each time to the nearest of increasing places."""
    after = np.searchsorted(places, times).clip(1, max(len(places) - 1, 1))
    beside = np.abs(times[:, None] - places[np.stack([after - 1, np.minimum(after, len(places) - 1)], axis=1)])
    return np.asarray(beside.min(axis=1))
