"""Factorials, which the language does not have: computed where their arguments are constant, else refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gbspec.imports.computing import NotConstantError, computed, has_factorial, value_of
from gbspec.imports.description import Description, Function, Quantity, Report
from gbspec.imports.formulas import Formula, replaced, substituted

Place = Callable[[str], tuple[str, int]]
"""The element and the line of a quantity or reaction."""


def inlined(formula: Formula, functions: dict[str, Function]) -> Formula:
    """A formula with the bodies of some functions in place of their applications."""

    def put(node: Formula) -> Formula | None:
        if node.head != "apply" or node.name not in functions:
            return None
        one = functions[node.name]
        arguments = [inlined(part, functions) for part in node.parts]
        return replaced(inlined(one.value, functions), dict(zip(one.arguments, arguments, strict=False)))

    return substituted(formula, put) if functions else formula


def to_inline(functions: list[Function]) -> dict[str, Function]:
    """The functions that the language cannot declare: without arguments, or with factorials."""
    found: dict[str, Function] = {}
    while True:
        more = {
            one.id: one
            for one in functions
            if one.id not in found and (not one.arguments or has_factorial(inlined(one.value, found)))
        }
        if not more:
            return found
        found |= more


def without_factorials(out: Description, report: Report, place: Place) -> None:
    """Replaces factorials by numbers in a description; notes each place, and refuses where one is not constant."""
    known: dict[str, float] = {}

    def put(name: str, formula: Formula) -> Formula:
        if not has_factorial(formula):
            return formula
        what, line = place(name)
        try:
            found = computed(formula, known)
        except NotConstantError:
            report.refuse(what, line, "the factorial of a quantity that is not constant has no form in the language")
            return formula
        report.omit(what, line, "the factorial of a constant is written as its value")
        return found

    out.constants = _in_order(out.constants, known, put)
    out.states = [q if q.value is None else replace(q, value=put(q.id, q.value)) for q in out.states]
    out.intermediates = [q if q.value is None else replace(q, value=put(q.id, q.value)) for q in out.intermediates]
    out.conversions = [
        replace(
            c,
            rate=put(c.id, c.rate),
            consumed=tuple((put(c.id, factor), state) for factor, state in c.consumed),
            produced=tuple((put(c.id, factor), state) for factor, state in c.produced),
        )
        for c in out.conversions
    ]
    out.events = [
        replace(
            e,
            condition=put(e.id, e.condition),
            after=None if e.after is None else put(e.id, e.after),
            priority=put(e.id, e.priority),
            values=tuple((state, put(e.id, v)) for state, v in e.values),
        )
        for e in out.events
    ]
    out.balances = {name: put(name, value) for name, value in out.balances.items()}


def _in_order(
    constants: list[Quantity], known: dict[str, float], put: Callable[[str, Formula], Formula]
) -> list[Quantity]:
    """The constants, each computed as soon as those that it needs are known."""
    left = {one.id: one for one in constants if one.value is not None and one.learn is None}
    progress = True
    while progress:
        progress = False
        for name, one in list(left.items()):
            assert one.value is not None
            try:
                known[name] = value_of(one.value, known)
            except NotConstantError:
                continue
            del left[name]
            progress = True
    return [one if one.value is None else replace(one, value=put(one.id, one.value)) for one in constants]
