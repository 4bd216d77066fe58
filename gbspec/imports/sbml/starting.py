"""Events of SBML at the start of a trajectory.

SBML's values at the start are those after such events, the language's those before. So what they set is written into
the starts of the states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from gbspec.imports.computing import NotConstantError, decided, value_of
from gbspec.imports.description import Description
from gbspec.imports.formulas import ORDERS, ZERO, Formula, named, names
from gbspec.imports.sbml.book import Happening, elements
from gbspec.imports.sbml.symbols import Starts, Symbols


def known_values(out: Description) -> dict[str, float]:
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


def check_start(symbols: Symbols, out: Description, condition: Formula, refuse: Callable[[str], None]) -> None:
    """Refuses a condition that is false at the start because a comparison is strict: the language has none."""
    starts, known = Starts(symbols), known_values(out)

    def guard(node: Formula) -> float:
        if node.head in ("and", "or"):
            return (min if node.head == "and" else max)(guard(part) for part in node.parts)
        if node.head == "not":
            return -guard(node.parts[0])
        if node.head not in ORDERS or not symbols.moves(node):
            return 1.0 if value_of(starts.of(node, states=True), known) else -1.0
        left, right = (value_of(starts.of(part, states=True), known) for part in node.parts)
        return left - right if node.head in (">", ">=") else right - left

    try:
        happens, holds = guard(condition) >= 0, bool(value_of(starts.of(condition, states=True), known))
    except NotConstantError:
        return
    if happens and not holds:
        refuse("at the start its trigger lies at its threshold without being true, which has no form")


def happened_at_start(symbols: Symbols, out: Description, happenings: Sequence[Happening]) -> tuple[set[str], set[str]]:
    """The events without a delay that happen at the start, after what they set is written into the starts; and those
    whose trigger is certainly false there."""
    ranges = {one.id: one.range for one in out.constants if one.learn is not None and one.range is not None}
    made = _Start(symbols, known_values(out), ranges)
    never = {one.id for one in happenings if one.armed and made.holds(one) is False}
    firing = [one for one in happenings if one.armed and one.delay == ZERO and made.holds(one, refused=True)]
    if not firing:
        return set(), never
    others = [one for one in happenings if one not in firing and made.holds(one) is not True]
    made.happen(firing)
    for one in others:
        if made.holds(one) is not False:
            symbols.refusing(one)("another event at the start can make it happen there, which is not offered yet")
    before = Starts(symbols)
    for i, state in enumerate(out.states):
        if state.id in made.changed:
            out.states[i] = replace(state, value=made.values[state.id])
        elif state.value is not None and names(state.value) & made.changed:  # of the starts before the events
            out.states[i] = replace(state, value=before.of(state.value, states=False))
    return {one.id for one in firing}, never


class _Start:
    """The start while events happen at it: `values` of all symbols, in constants."""

    def __init__(self, symbols: Symbols, known: Mapping[str, float], ranges: Mapping[str, tuple[float, float]]) -> None:
        self.symbols, self.ranges = symbols, ranges
        self.known = {name: value for name, value in known.items() if name in symbols.constants}
        self.values: dict[str, Formula | None] = dict(symbols.starts)
        self.changed: set[str] = set()

    def of(self, formula: Formula) -> Formula:
        return Starts(replace(self.symbols, starts=dict(self.values))).of(formula, states=False)

    def holds(self, one: Happening, refused: bool = False) -> bool | None:
        """Whether the trigger of an event is true; None where that cannot be computed."""
        try:
            return bool(value_of(self.of(one.condition), self.known))
        except NotConstantError:
            found = decided(self.of(one.condition), self.known, self.ranges)
            if found is None and refused:
                reason = "whether it happens at the start cannot be computed, and such events are not offered yet"
                self.symbols.refusing(one)(reason)
            return found

    def happen(self, firing: Sequence[Happening]) -> None:
        """Events in the order of their priorities, each computed when its turn comes."""
        early = {one.id: {k: self.of(v) for k, v in one.values.items()} for one in firing}
        left = list(firing)
        while left:
            one = max(left, key=self._priority)
            left.remove(one)
            if not one.persistent and self.holds(one) is False:
                continue
            self._set(one, early[one.id] if one.early else {k: self.of(v) for k, v in one.values.items()})

    def _set(self, one: Happening, values: Mapping[str, Formula]) -> None:
        """Symbols with new values; amounts in compartments that are among them are kept, unless they are set too."""
        model, amounts = self.symbols.book.model, dict[str, Formula]()
        for species in elements(model.getListOfSpecies()):
            name, compartment = species.getId(), species.getCompartment()
            amount, resized = self.symbols.amounts.get(name), compartment in values
            if amount is not None and name in values:
                amounts[amount] = self.of(values[name] * named(compartment))
            elif amount is not None and resized:
                amounts[amount] = self.of(self.values[amount] or ZERO)
            elif resized and name in self.symbols.states and not species.getHasOnlySubstanceUnits():
                self.symbols.refusing(one)("it changes a compartment at the start, which is not offered yet")
        self.values |= {**values, **amounts}
        for name, amount in self.symbols.amounts.items():
            if amount in amounts:
                self.values[name] = named(amount) / named(model.getSpecies(name).getCompartment())
        self.changed |= values.keys() | amounts.keys()

    def _priority(self, one: Happening) -> float:
        try:
            return value_of(self.of(one.priority), self.known)
        except NotConstantError:
            self.symbols.refusing(one)("its priority at the start cannot be computed, which is not offered yet")
            return 0.0
