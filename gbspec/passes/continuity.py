"""Comparisons at which a value jumps: those where the branches of its `if` do not agree.

`if(x > 0, x/(K + x), 0)` has a kink where x passes zero, `if(x > 0, 1, 0)` a jump. Branches agree where their
difference, as rational numbers and with the threshold in the place of one symbol, is zero after an expansion. What is
not shown to agree counts as a jump.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import sympy
from sympy.core.relational import Relational

from gbspec.ir import Expr, Model
from gbspec.passes.shapes import same, with_fractions

LARGEST = 200
"""A difference of branches with more operations is not expanded, since that may take long."""
_POINTS = (sympy.Eq, sympy.Ne)
"""Comparisons that hold, or fail, at single points: a value there tells nothing of those beside it."""


def jumping(model: Model) -> frozenset[sympy.Basic]:
    """The comparisons in right-hand sides and intermediates at which one of these may jump."""
    positive = {
        item.symbol: sympy.Dummy(item.name, positive=True)
        for item in model.learnables
        if item.individual.range.low > 0 or (item.distribution is not None and item.distribution.kind == "lognormal")
    }
    found: set[sympy.Basic] = set()
    seen: set[sympy.Basic] = set()
    left: list[sympy.Basic] = [*model.balances, *(item.value for item in model.intermediates)]
    while left:
        node = left.pop()
        if node in seen:
            continue
        seen.add(node)
        if isinstance(node, sympy.Piecewise):
            found |= _of_branches(model, node, positive)
            left += [part for value, condition in node.args for part in (value, *_compared(condition))]
        else:
            found |= {node} if isinstance(node, Relational) else set()  # outside a condition: nothing is known of it
            left += node.args
    return frozenset(found)


def _compared(condition: sympy.Basic) -> Iterable[sympy.Basic]:
    """Both sides of all comparisons of a condition."""
    return [side for one in condition.atoms(Relational) for side in one.args]


def _of_branches(model: Model, node: sympy.Piecewise, positive: Mapping[sympy.Basic, sympy.Basic]) -> set[sympy.Basic]:
    """The comparisons of a value by cases at which it may jump."""
    conditions = [condition for _, condition in node.args]
    inside = {one for condition in conditions for one in condition.atoms(Relational)}
    if inside != {one for condition in conditions for one in _outermost(condition)}:
        return inside  # a condition compares what other conditions decide
    parts = model.inlined([part for value, condition in node.args for part in (value, condition)])
    exact = [with_fractions(part).xreplace(dict(positive)) for part in parts]
    if any(part.has(*_POINTS) for part in exact):
        return inside
    branches = list(zip(exact[::2], exact[1::2], strict=True))
    found: set[sympy.Basic] = set()
    for place, condition in enumerate(conditions):
        for one in condition.atoms(Relational):
            guard = with_fractions(model.inlined([one.lhs - one.rhs])[0]).xreplace(dict(positive))
            if not _agree(guard, branches[place][0], branches[place + 1 :]):
                found.add(one)
    return found


def _outermost(condition: sympy.Basic) -> Iterable[sympy.Basic]:
    """The comparisons of a condition that are in no other comparison."""
    if isinstance(condition, Relational):
        return [condition]
    return [one for part in condition.args for one in _outermost(part)]


def _agree(guard: Expr, value: Expr, rest: Iterable[tuple[Expr, sympy.Basic]]) -> bool:
    """Whether a branch has the value of all that may hold instead of it where `guard` is zero."""
    solved = _solved(guard)
    if solved is None:
        return False
    try:
        for other, condition in rest:
            holds = condition.subs(*solved)
            if holds == sympy.false:
                continue
            if not _zero((value - other).subs(*solved)):
                return False
            if holds == sympy.true:
                return True
    except TypeError:  # a comparison with what is infinite there
        return False
    return True


def _zero(difference: Expr) -> bool:
    """Whether a difference is shown to be zero; a large one is not looked at."""
    return bool(difference == 0) or (sympy.count_ops(difference) <= LARGEST and same(difference, sympy.S.Zero))


def _solved(guard: Expr) -> tuple[sympy.Basic, Expr] | None:
    """A symbol and its value where `guard` is zero, and nowhere else; None where it is linear in none."""
    for symbol in sorted(guard.free_symbols, key=str):
        slope = guard.diff(symbol)
        offset = sympy.expand(guard - slope * symbol)
        # A slope that vanishes somewhere has other zeros of the guard there.
        if sympy.fraction(sympy.together(slope))[0].is_number and symbol not in offset.free_symbols and slope != 0:
            return symbol, -offset / slope
    return None
