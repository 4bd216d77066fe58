"""Events of SBML that can happen at one time: which see values from before the others, and which the others cancel."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import permutations

from gbspec.imports.computing import NotConstantError, value_of
from gbspec.imports.description import Description, Event
from gbspec.imports.formulas import ORDERS, Formula, named, names, replaced
from gbspec.imports.sbml.book import Happening
from gbspec.imports.sbml.starting import known_values
from gbspec.imports.sbml.symbols import Symbols

_THRESHOLD = "another event sets a quantity to its threshold, where its trigger is not true, which has no form"
_SIZE = "it sets the concentration `{}` to a value of another time than its compartment's size, which has no form"
_RANDOM = "it and another event of the same priority cancel each other in random order, which has no form"


def compare_events(symbols: Symbols, out: Description) -> None:
    """Writes `sampled` and `transient` where another event at the same time makes them necessary.

    SBML computes values when events are triggered, before others at that time; the language after them.
    """
    sources = {one.id: one for one in symbols.book.events}
    known = {name: value for name, value in known_values(out).items() if name in symbols.constants}
    strict = {one.id: [n for n in _strict(one.condition) if symbols.moves(n)] for one in out.events}
    reads = {one.id: _reached(symbols, sources[one.id].values.values()) for one in out.events}
    needs = {one.id: symbols.reached(one.condition)[0] for one in out.events}
    sets = {one.id: {state for state, _ in one.values} for one in out.events}
    targets = set().union(*sets.values()) if sets else set()
    sizes = {one.id: _reached(symbols, _sizes(symbols, sources[one.id]).values()) for one in out.events}
    sampled, transient, resized = set(), set(), set()
    for first, second in permutations(out.events, 2):
        source, other = sources[second.id], sources[first.id]
        if any(_touches(first, node, known) for node in strict[second.id]):
            symbols.refusing(source)(_THRESHOLD)
        early = source.early and bool(sets[first.id] & reads[second.id])
        cancels = not source.persistent and bool(sets[first.id] & needs[second.id])
        resizes = bool(sets[first.id] & sizes[second.id])
        if not (early or cancels or resizes) or _never_together(first, second, symbols, known, targets):
            continue
        ranks = _rank(first, known), _rank(second, known)
        mutual = cancels and not other.persistent and bool(sets[second.id] & needs[first.id])
        if mutual and None not in ranks and ranks[0] == ranks[1] and source.ranked and other.ranked:
            symbols.refusing(source)(_RANDOM)
        if None not in ranks and _later(first, second, ranks, out):
            continue
        sampled |= {second.id} if early else set()
        transient |= {second.id} if cancels else set()
        resized |= {second.id} if resizes else set()
    out.events = [
        replace(one, sampled=one.sampled or one.id in sampled, transient=one.transient or one.id in transient)
        for one in out.events
    ]
    for event in out.events:
        if event.sampled and (event.after is not None or event.id in resized):
            _check_sizes(symbols, sources[event.id])


def _reached(symbols: Symbols, formulas: Iterable[Formula]) -> set[str]:
    """The names that formulas depend on."""
    return set().union(*(symbols.reached(one)[0] for one in formulas))


def _sizes(symbols: Symbols, source: Happening) -> dict[str, Formula]:
    """The sizes by which concentrations that an event sets become amounts."""
    found = {name: symbols.book.model.getSpecies(name) for name in source.values if name in symbols.amounts}
    return {name: named(species.getCompartment()) for name, species in found.items()}


def _check_sizes(symbols: Symbols, source: Happening) -> None:
    """Refuses concentrations of another time than the size by which they become amounts: `sampled` is of both."""
    for name, size in _sizes(symbols, source).items():
        if symbols.changes(size):
            symbols.refusing(source)(_SIZE.format(name))


def _rank(event: Event, known: Mapping[str, float]) -> float | None:
    """The priority of an event, if it is a number."""
    try:
        return value_of(event.priority, known)
    except NotConstantError:
        return None


def _later(first: Event, second: Event, ranks: tuple[float | None, float | None], out: Description) -> bool:
    """Whether the first of two events comes after the second, where both priorities are known."""
    one, other = ranks
    assert one is not None
    assert other is not None
    return one < other or (one == other and out.events.index(first) > out.events.index(second))


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
    if first.after is not None or second.after is not None:
        return False
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
    if condition.head not in ORDERS:
        return None
    rises = condition.head in (">", ">=")
    left, right = condition.parts
    for quantity, bound, up in ((left, right, rises), (right, left, not rises)):
        try:
            return quantity, up, value_of(bound, known)
        except NotConstantError:
            continue
    return None
