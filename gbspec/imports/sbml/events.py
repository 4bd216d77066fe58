"""Events of SBML as events of the language, where both give the same solutions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from gbspec.imports.computing import value_of
from gbspec.imports.description import Description, Event, Function, Rest
from gbspec.imports.formulas import (
    FALSE,
    ORDERS,
    TRUE,
    ZERO,
    Formula,
    as_condition,
    both,
    either,
    named,
    names,
    negated,
    number,
    walk,
)
from gbspec.imports.sbml.book import Book, Happening, elements
from gbspec.imports.sbml.factorials import inlined
from gbspec.imports.sbml.reading import Element
from gbspec.imports.sbml.starting import check_start, happened_at_start
from gbspec.imports.sbml.symbols import Symbols, described
from gbspec.imports.sbml.together import compare_events

MOST_EVENTS = 500
"""The number of events of a model; each pair of them is looked at."""


def read_events(book: Book) -> None:
    """The events of a model in its book; what is not offered is refused."""
    found = elements(book.model.getListOfEvents())
    if len(found) > MOST_EVENTS:
        book.report.refuse("listOfEvents", found[0].getLine(), f"more than {MOST_EVENTS} events are not offered")
        return
    taken: set[str] = set()
    for i, element in enumerate(found, 1):
        name = element.getId() or f"event_{i}"
        while not element.getId() and (book.model.getElementBySId(name) is not None or name in taken):
            name += "_"
        taken.add(name)
        made = _happening(book, name, element)
        if made is not None:
            book.events.append(made)


def _happening(book: Book, name: str, element: Element) -> Happening | None:
    what, line = f"event {name}", element.getLine()
    late = element.getLevel() > 2
    delayed = element.isSetDelay() and element.getDelay().isSetMath()
    ranked = late and element.isSetPriority() and element.getPriority().isSetMath()
    delay = (book.math(element.getDelay(), what) if delayed else None) or ZERO
    priority = (book.math(element.getPriority(), what) if ranked else None) or ZERO
    trigger = element.getTrigger()
    condition = None if trigger is None else book.math(trigger, what)
    values = {}
    for one in elements(element.getListOfEventAssignments()):
        value = book.math(one, f"eventAssignment of {one.getVariable()} in {name}")
        if value is not None:
            values[one.getVariable()] = value
            _settable(book, what, one)
    if condition is None or not values:
        book.report.omit(what, line, "it has no trigger, or sets nothing, and so no effect")
        return None
    return Happening(
        name,
        condition,
        values,
        delay,
        priority,
        ranked,
        armed=late and not trigger.getInitialValue(),
        persistent=not late or trigger.getPersistent(),
        early=element.getUseValuesFromTriggerTime() if late or element.isSetUseValuesFromTriggerTime() else True,
        element=element,
    )


def _settable(book: Book, what: str, assignment: Element) -> None:
    """Refuses targets that no event can set."""
    name, model = assignment.getVariable(), book.model
    found = model.getSpecies(name) or model.getParameter(name) or model.getCompartment(name)
    found = found or book.references.get(name)
    if found is None:
        book.report.refuse(what, assignment.getLine(), f"it sets `{name}`, which is no quantity")
    elif found.getConstant() or name in book.assigned:
        book.report.refuse(what, assignment.getLine(), f"it sets `{name}`, which is constant or has a rule")


# -------------------------------------------------------------------------------------------------- in the language
def add_events(symbols: Symbols, out: Description, functions: dict[str, Function]) -> None:
    """The events of a description whose quantities are complete."""
    plain = [
        replace(one, condition=_plain(as_condition(inlined(one.condition, functions)))) for one in symbols.book.events
    ]
    started, never = happened_at_start(symbols, out, plain)
    for one in plain:
        condition = one.condition
        refuse = symbols.refusing(one)
        if not symbols.changes(condition):
            if one.id not in started:
                symbols.book.report.omit(f"event {one.id}", one.element.getLine(), "its trigger never changes")
            continue
        _check_condition(symbols, condition, refuse)
        check_start(symbols, out, condition, refuse)
        if out.rest is not None:
            _check_rest(out.rest, condition, refuse)
        values = values_set(symbols, one.values)
        symbols.lines[one.id] = (f"event {one.id}", one.element.getLine())
        out.events.append(
            Event(
                one.id,
                condition,
                values,
                one.priority,
                one.armed and one.id not in started and not (out.rest is not None and one.id in never),
                None if one.delay == ZERO else one.delay,
                one.delay != ZERO and one.early and any(map(symbols.changes, one.values.values())),
                one.delay != ZERO and not one.persistent,
                description=described(one.element),
                at=one.at,
            )
        )
    compare_events(symbols, out)
    for event in out.events:
        if event.sampled and len(event.values) > len(symbols.book.event(event.id).values):
            reason = (
                "it sets a compartment with a species whose concentration has a rate rule, to a value of another time"
            )
            symbols.refusing(symbols.book.event(event.id))(reason)


def _check_rest(rest: Rest, condition: Formula, refuse: Callable[[str], None]) -> None:
    """Refuses a trigger that could become true by what is set when a steady state was found."""
    changed = {name for name, _ in (*rest.held, *rest.after)}
    if names(condition) & changed:
        refuse("its trigger depends on what changes after the steady state, which is not offered yet")


def values_set(symbols: Symbols, given: Mapping[str, Formula]) -> tuple[tuple[str, Formula], ...]:
    """What an event sets: amounts where the language has them, by the size before the event; concentrations that keep
    their amount when it sets their compartment."""
    model, values = symbols.book.model, []
    for name, value in given.items():
        amount = symbols.amounts.get(name)
        if amount is not None:
            value = value * named(model.getSpecies(name).getCompartment())
        values.append((amount or name, value))
    for species in elements(model.getListOfSpecies()):
        name, compartment = species.getId(), species.getCompartment()
        ruled = name in symbols.book.rates and not species.getHasOnlySubstanceUnits()
        if ruled and compartment in given and name not in given:
            values.append((name, Formula("/", (named(name) * named(compartment), given[compartment]))))
    return tuple(values)


def _plain(node: Formula) -> Formula:
    """A condition without comparisons of truth values that were made into numbers."""
    if node.head in ("and", "or"):
        parts = [_plain(part) for part in node.parts]
        return both(parts) if node.head == "and" else either(parts)
    if node.head == "not":
        return negated(_plain(node.parts[0]))
    if node.head == "if" and all(part.head == "number" for part in node.parts[1:]):
        return _choice(node, lambda value: value != 0)
    if node.head in (*ORDERS, "=="):
        left, right = node.parts
        if left.head == right.head == "number":
            return TRUE if value_of(node, {}) else FALSE
        for choice, other in ((left, right), (right, left)):
            if choice.head == "if" and all(p.head == "number" for p in (*choice.parts[1:], other)):
                sides = (choice is left, other)

                def holds(value: float, sides: tuple[bool, Formula] = sides) -> bool:
                    pair = (number(value), sides[1]) if sides[0] else (sides[1], number(value))
                    return bool(value_of(Formula(node.head, pair), {}))

                return _choice(choice, holds)
    return as_condition(node)


def _choice(node: Formula, holds: Callable[[float], bool]) -> Formula:
    condition = _plain(as_condition(node.parts[0]))
    first, second = (holds(part.value) for part in node.parts[1:])
    if first == second:
        return TRUE if first else FALSE
    return condition if first else negated(condition)


def _check_condition(symbols: Symbols, condition: Formula, refuse: Callable[[str], None]) -> None:
    def jumps(node: Formula) -> bool:
        if node.head == "name" and node.name in symbols.intermediates:
            value = symbols.intermediates[node.name].value
            return value is not None and any(map(jumps, walk(value)))
        return node.head == "call" and node.name in ("floor", "ceil", "mod") and symbols.moves(node)

    for node in walk(condition):
        if jumps(node):
            refuse("a trigger with `floor`, `ceiling`, `quotient` or `rem` of what changes continuously is not offered")
        if node.head == "==" and symbols.moves(node):
            refuse("a trigger with `==` of what changes continuously has no form in the language")
