"""Events of SBML as events of the language: those without a delay, where both give the same solutions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations, permutations

from gbspec.imports.computing import NotConstantError, value_of
from gbspec.imports.description import Description, Event, Function
from gbspec.imports.formulas import (
    FALSE,
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
    replaced,
    walk,
)
from gbspec.imports.sbml.book import Book, Happening, elements
from gbspec.imports.sbml.reading import Element
from gbspec.imports.sbml.rounding import inlined
from gbspec.imports.sbml.symbols import Starts, Symbols, described

MOST_EVENTS = 500
"""The number of events of a model; each pair of them is looked at."""
_ORDERS = ("<", "<=", ">", ">=")
_COMPARISONS = (*_ORDERS, "==")
_SHARED = (
    "it can happen together with another event that changes what it is computed from; only values after that event "
    "have a form in the language"
)


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
    if element.isSetDelay() and element.getDelay().isSetMath() and book.math(element.getDelay(), what) != ZERO:
        book.report.refuse(what, line, "events with a delay are not offered yet")
        return None
    priority = 0.0
    if element.getLevel() > 2 and element.isSetPriority() and element.getPriority().isSetMath():
        try:
            priority = value_of(book.math(element.getPriority(), what) or ZERO, {})
        except NotConstantError:
            book.report.refuse(what, line, "a priority that is not a number is not offered yet")
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
    late = element.getLevel() > 2
    return Happening(
        name,
        condition,
        values,
        priority,
        armed=late and not trigger.getInitialValue(),
        persistent=not late or trigger.getPersistent(),
        early=element.getUseValuesFromTriggerTime() if late or element.isSetUseValuesFromTriggerTime() else True,
        element=element,
    )


def _settable(book: Book, what: str, assignment: Element) -> None:
    """Refuses targets that no event can set."""
    name, model = assignment.getVariable(), book.model
    found = model.getSpecies(name) or model.getParameter(name) or model.getCompartment(name)
    if found is None:
        book.report.refuse(what, assignment.getLine(), "an event that sets a stoichiometry is not offered yet")
    elif found.getConstant() or name in book.assigned:
        book.report.refuse(what, assignment.getLine(), f"it sets `{name}`, which is constant or has a rule")
    elif model.getCompartment(name) is not None and any(
        s.getCompartment() == name and s.getId() in book.rates and not s.getHasOnlySubstanceUnits()
        for s in elements(model.getListOfSpecies())
    ):
        reason = "it sets a compartment with a species whose concentration has a rate rule, which is not offered"
        book.report.refuse(what, assignment.getLine(), reason)


# -------------------------------------------------------------------------------------------------- in the language
def add_events(symbols: Symbols, out: Description, functions: dict[str, Function]) -> None:
    """The events of a description whose quantities are complete."""
    for one in symbols.book.events:
        condition = _plain(as_condition(inlined(one.condition, functions)))
        refuse = _refusing(symbols, one)
        if not _changes(symbols, condition):
            if one.armed:
                refuse("its trigger never changes, so that it can happen at the start only")
            else:
                symbols.book.report.omit(f"event {one.id}", one.element.getLine(), "its trigger never changes")
            continue
        _check_condition(symbols, condition, refuse)
        _check_start(symbols, out, condition, one.armed, refuse)
        values = []
        for name, value in one.values.items():
            state = symbols.amounts.get(name)
            if state is None:
                values.append((name, value))
                continue
            compartment = symbols.book.model.getSpecies(name).getCompartment()
            if compartment in one.values:
                refuse("it sets a concentration and its compartment, which is not offered yet")
            values.append((state, value * named(compartment)))
        symbols.lines[one.id] = (f"event {one.id}", one.element.getLine())
        out.events.append(Event(one.id, condition, tuple(values), one.priority, one.armed, described(one.element)))
    _refuse_shared(symbols, out)


def _refusing(symbols: Symbols, one: Happening) -> Callable[[str], None]:
    return lambda reason: symbols.book.report.refuse(f"event {one.id}", one.element.getLine(), reason)


def _plain(node: Formula) -> Formula:
    """A condition without comparisons of truth values that were made into numbers."""
    if node.head in ("and", "or"):
        parts = [_plain(part) for part in node.parts]
        return both(parts) if node.head == "and" else either(parts)
    if node.head == "not":
        return negated(_plain(node.parts[0]))
    if node.head == "if" and all(part.head == "number" for part in node.parts[1:]):
        return _choice(node, lambda value: value != 0)
    if node.head in _COMPARISONS:
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


def _reached(symbols: Symbols, formula: Formula) -> tuple[set[str], bool]:
    """The names that a formula depends on, also through other formulas, and whether it depends on the time."""
    found: set[str] = set()
    open_, time = [formula], False
    while open_:
        one = open_.pop()
        time |= any(node.head == "time" for node in walk(one))
        for name in names(one) - found:
            found.add(name)
            reaction = symbols.book.reactions.get(name)
            quantity = symbols.intermediates.get(name)
            value = reaction.law if reaction else quantity.value if quantity else None
            if value is not None:
                open_.append(value)
    return found, time


def _changes(symbols: Symbols, formula: Formula) -> bool:
    found, time = _reached(symbols, formula)
    return time or bool(found & symbols.states.keys())


def _moves(symbols: Symbols, formula: Formula) -> bool:
    """Whether a formula changes other than by events."""
    found, time = _reached(symbols, formula)
    return time or any(name in symbols.states and not symbols.states[name].discrete for name in found)


def _check_condition(symbols: Symbols, condition: Formula, refuse: Callable[[str], None]) -> None:
    for node in walk(condition):
        if node.head == "==" and _moves(symbols, node):
            refuse("a trigger with `==` of what changes continuously has no form in the language")


def _check_start(
    symbols: Symbols, out: Description, condition: Formula, armed: bool, refuse: Callable[[str], None]
) -> None:
    """Refuses a condition that is false at the start because a comparison is strict: the language has no strict ones;
    and an event that happens at the start: SBML's values there are those after it, the language's those before."""
    starts, known = Starts(symbols), _known(out)

    def guard(node: Formula) -> float:
        if node.head in ("and", "or"):
            return (min if node.head == "and" else max)(guard(part) for part in node.parts)
        if node.head == "not":
            return -guard(node.parts[0])
        if node.head not in _ORDERS or not _moves(symbols, node):
            return 1.0 if value_of(starts.of(node, states=True), known) else -1.0
        left, right = (value_of(starts.of(part, states=True), known) for part in node.parts)
        return left - right if node.head in (">", ">=") else right - left

    try:
        happens, holds = guard(condition) >= 0, bool(value_of(starts.of(condition, states=True), known))
    except NotConstantError:
        if armed:
            refuse("whether it happens at the start cannot be computed, and such events are not offered yet")
        return
    if happens and not holds:
        refuse("at the start its trigger lies at its threshold without being true, which has no form")
    elif armed and holds:
        refuse("events that happen at the start are not offered yet")


def _known(out: Description) -> dict[str, float]:
    """The constants and the starts of states that are numbers, and are neither learned nor given by a table."""
    known: dict[str, float] = {}
    fixed = (one for one in (*out.constants, *out.states) if one.learn is None and not one.condition)
    left = {one.id: one.value for one in fixed if one.value is not None}
    progress = True
    while progress:
        progress = False
        for name, value in list(left.items()):
            try:
                known[name] = value_of(value, known)
            except NotConstantError:
                continue
            del left[name]
            progress = True
    return known


# ------------------------------------------------------------------------------------------------ events together
def _refuse_shared(symbols: Symbols, out: Description) -> None:
    """SBML computes values when events are triggered, before others at that time; the language after them."""
    sources = {one.id: one for one in symbols.book.events}
    ordered = sorted(out.events, key=lambda event: -event.priority)
    known = {name: value for name, value in _known(out).items() if name in symbols.constants}
    strict = {one.id: [n for n in _strict(one.condition) if _moves(symbols, n)] for one in out.events}
    reads = {one.id: set().union(*(_reached(symbols, v)[0] for _, v in one.values)) for one in out.events}
    needs = {one.id: _reached(symbols, one.condition)[0] for one in out.events}
    for first, second in permutations(out.events, 2):
        if any(_touches(first, node, known) for node in strict[second.id]):
            reason = "another event sets a quantity to its threshold, where its trigger is not true, which has no form"
            _refusing(symbols, sources[second.id])(reason)
    targets = {state for event in out.events for state, _ in event.values}
    for first, second in combinations(ordered, 2):
        source, changed = sources[second.id], {state for state, _ in first.values}
        early = source.early and bool(changed & reads[second.id])
        cancels = not source.persistent and bool(changed & needs[second.id])
        if not (early or cancels) or _never_together(first, second, symbols, known, targets):
            continue
        if early:
            _refusing(symbols, source)(_SHARED)
        if cancels:
            _refusing(symbols, source)("another event at the same time can cancel it, which has no form")


def _strict(node: Formula, negative: bool = False) -> Iterator[Formula]:
    """The comparisons of a condition that do not hold between equal numbers."""
    if node.head in ("and", "or", "not"):
        for part in node.parts:
            yield from _strict(part, negative != (node.head == "not"))
    elif node.head in (("<=", ">=") if negative else ("<", ">")):
        yield node


def _touches(event: Event, comparison: Formula, known: dict[str, float]) -> bool:
    """Whether an event makes the sides of a comparison equal, as far as that can be computed."""
    if not names(comparison) & dict(event.values).keys():
        return False
    try:
        left, right = (value_of(replaced(part, dict(event.values)), known) for part in comparison.parts)
    except NotConstantError:
        return False
    return left == right


def _never_together(first: Event, second: Event, symbols: Symbols, known: dict[str, float], targets: set[str]) -> bool:
    """Whether two events provably never happen at one time: opposite sides of one quantity, or two thresholds of a
    quantity that no event changes."""
    one, other = (_threshold(event.condition, known) for event in (first, second))
    if one is None or other is None or one[0] != other[0] or (first.armed and second.armed):
        return False
    if one[1] != other[1]:
        return True
    node = one[0]
    smooth = node.head == "time" or (node.head == "name" and node.name in symbols.states and node.name not in targets)
    return smooth and one[2] != other[2]


def _threshold(condition: Formula, known: dict[str, float]) -> tuple[Formula, bool, float] | None:
    """A comparison with a number: what is compared, whether it rises above, and the number."""
    if condition.head not in _ORDERS:
        return None
    rises = condition.head in (">", ">=")
    left, right = condition.parts
    for quantity, bound, up in ((left, right, rises), (right, left, not rises)):
        try:
            return quantity, up, value_of(bound, known)
        except NotConstantError:
            continue
    return None
