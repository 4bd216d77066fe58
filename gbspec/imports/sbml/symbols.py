"""What each symbol becomes: a constant, an intermediate, or a state; and the start of each.

A species whose symbol is a concentration is a state in concentrations where its compartment keeps its size. Where the
size changes, reactions change the amount, so that the amount is the state, and the concentration an intermediate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from gbspec.imports.description import Quantity
from gbspec.imports.formulas import ZERO, Formula, named, names, number, substituted, walk
from gbspec.imports.sbml.book import Book, Happening, Reaction, elements, finite, literal_factor
from gbspec.imports.sbml.reading import Element
from gbspec.imports.sbml.units import species_unit, unit_of


@dataclass
class Symbols:
    """The quantities of a model. `starts` has the value at the start of every symbol that is no reaction, in constants
    and other starts; None where the file gives none."""

    book: Book
    constants: dict[str, Quantity] = field(default_factory=dict)
    intermediates: dict[str, Quantity] = field(default_factory=dict)
    states: dict[str, Quantity] = field(default_factory=dict)
    starts: dict[str, Formula | None] = field(default_factory=dict)
    lines: dict[str, tuple[str, int]] = field(default_factory=dict)
    amounts: dict[str, str] = field(default_factory=dict)
    """The name of the amount of each species whose concentration is an intermediate."""
    divisors: dict[str, str] = field(default_factory=dict)
    """The compartment of each species that reacts and is a concentration."""

    def reacts(self, species: str) -> bool:
        """Whether reactions change a species."""
        element = self.book.model.getSpecies(species)
        if element is None or element.getConstant() or element.getBoundaryCondition():
            return False
        return any(
            r.law is not None and any(t.species == species for t in r.terms) for r in self.book.reactions.values()
        )

    def state_of(self, species: str) -> str:
        """The state that reactions of a species change."""
        return self.amounts.get(species, species)

    def reached(self, formula: Formula) -> tuple[set[str], bool]:
        """The names that a formula depends on, also through other formulas, and whether it depends on the time."""
        found: set[str] = set()
        open_, time = [formula], False
        while open_:
            one = open_.pop()
            time |= any(node.head == "time" for node in walk(one))
            for name in names(one) - found:
                found.add(name)
                reaction, quantity = self.book.reactions.get(name), self.intermediates.get(name)
                value = reaction.law if reaction else quantity.value if quantity else None
                if value is not None:
                    open_.append(value)
        return found, time

    def changes(self, formula: Formula) -> bool:
        """Whether a formula changes over time."""
        found, time = self.reached(formula)
        return time or bool(found & self.states.keys())

    def moves(self, formula: Formula) -> bool:
        """Whether a formula changes other than by events."""
        found, time = self.reached(formula)
        return time or any(name in self.states and not self.states[name].discrete for name in found)

    def refusing(self, one: Happening) -> Callable[[str], None]:
        """What refuses an event by a reason."""
        return lambda reason: self.book.report.refuse(f"event {one.id}", one.element.getLine(), reason)

    def place(self, name: str) -> tuple[str, int]:
        """The element and line of a symbol."""
        reaction = self.book.reactions.get(name)
        return (f"reaction {name}", reaction.element.getLine()) if reaction else self.lines.get(name, (name, 0))

    def fixed(self, compartment: str) -> bool:
        """Whether a compartment keeps its size."""
        return not any(compartment in one for one in (self.book.assigned, self.book.rates, self.book.targets()))


def read_symbols(book: Book) -> Symbols:
    """The quantities of a model."""
    out = Symbols(book)
    model = book.model
    for compartment in elements(model.getListOfCompartments()):
        size = compartment.getSize() if compartment.isSetSize() else None
        _simple(out, compartment, "compartment", size)
    for parameter in elements(model.getListOfParameters()):
        _simple(out, parameter, "parameter", parameter.getValue() if parameter.isSetValue() else None)
    for name, (value, element) in book.local.items():
        out.lines[name] = (f"parameter {name}", element.getLine())
        out.starts[name] = value
        out.constants[name] = Quantity(name, value, described(element), unit_of(element))
    for name, reference in book.references.items():
        _reference(out, name, reference)
    for species in elements(model.getListOfSpecies()):
        _species(out, species)
    return out


def described(element: Element) -> str:
    """The description of an element: its name, if it says more than the id."""
    name = element.getName()
    return name if name and name != element.getId() else ""


def _simple(out: Symbols, element: Element, kind: str, value: float | None) -> None:
    """A parameter or a compartment, whose symbol is its value."""
    name = element.getId()
    out.lines[name] = (f"{kind} {name}", element.getLine())
    literal = None if value is None else finite(out.book.report, f"{kind} {name}", element, value)
    _declare(out, name, literal, described(element), unit_of(element))


def _reference(out: Symbols, name: str, reference: Element) -> None:
    out.lines[name] = (f"speciesReference {name}", reference.getLine())
    _declare(out, name, literal_factor(reference), described(reference), None)


def _declare(out: Symbols, name: str, literal: Formula | None, description: str, unit: str | None) -> None:
    book = out.book
    start = book.starts.get(name, literal)
    out.starts[name] = start
    if name in book.assigned:
        out.intermediates[name] = Quantity(name, book.assigned[name], description, unit)
        out.starts[name] = book.assigned[name]
    elif name in book.rates:
        out.states[name] = Quantity(name, start, description, unit)
    elif name in book.targets() and not out.reacts(name):
        out.states[name] = Quantity(name, start, description, unit, discrete=True)
    else:
        out.constants[name] = Quantity(name, start, description, unit)


def _species(out: Symbols, species: Element) -> None:
    book, name, compartment = out.book, species.getId(), species.getCompartment()
    out.lines[name] = (f"species {name}", species.getLine())
    amount_only = is_amount(out.book, species)
    literal = _literal(book, species, amount_only)
    description = described(species)
    if name in book.assigned or name in book.rates or amount_only or out.fixed(compartment):
        _declare(out, name, literal, description, species_unit(species, amount_only))
        if out.reacts(name) and name not in out.constants:
            book.report.refuse(*out.lines[name], "it has a rule, and reactions change it too")
        elif out.reacts(name):
            out.states[name] = out.constants.pop(name)
            if not amount_only:
                out.divisors[name] = compartment
        return
    amount = name + "_amount"
    while book.model.getElementBySId(amount) is not None or amount in book.local:
        amount += "_"
    start = book.starts.get(name, literal)
    out.starts[name] = start
    whole = None if start is None else start * named(compartment)
    out.starts[amount] = whole
    out.lines[amount] = out.lines[name]
    out.amounts[name] = amount
    said = f"amount of {description or name}"
    discrete = name in book.targets() and not out.reacts(name)
    changes = discrete or out.reacts(name)
    (out.states if changes else out.constants)[amount] = Quantity(amount, whole, said, discrete=discrete)
    out.intermediates[name] = Quantity(
        name, named(amount) / named(compartment), description, species_unit(species, amount_only)
    )


def is_amount(book: Book, species: Element) -> bool:
    """Whether the symbol of a species is its amount, and not its concentration."""
    compartment = book.model.getCompartment(species.getCompartment())
    if compartment is not None and compartment.getSpatialDimensionsAsDouble() == 0:
        return True
    return bool(species.getHasOnlySubstanceUnits())


def _literal(book: Book, species: Element, amount_only: bool) -> Formula | None:
    """The start of a species' symbol as its attributes give it. A size that is a plain number is divided by at once,
    so that the start is a number, which has the unit of the species."""
    name = species.getCompartment()
    compartment, element = named(name), book.model.getCompartment(name)
    plain = element is not None and element.isSetSize() and element.getSize() > 0 and element.getConstant()
    size = element.getSize() if plain and name not in book.starts and name not in book.assigned else None
    if species.isSetInitialConcentration():
        value = finite(book.report, f"species {species.getId()}", species, species.getInitialConcentration())
        if value is None or not amount_only or value == ZERO:
            return value
        return value * compartment if size is None else number(value.value * size)
    if species.isSetInitialAmount():
        value = finite(book.report, f"species {species.getId()}", species, species.getInitialAmount())
        if value is None or amount_only or value == ZERO:
            return value
        return Formula("/", (value, compartment)) if size is None else number(value.value / size)
    return None


class Starts:
    """Values at the start, written in constants alone, or in constants and the starts of states."""

    def __init__(self, symbols: Symbols) -> None:
        self.symbols = symbols
        self._open: list[str] = []

    def of(self, formula: Formula, states: bool) -> Formula:
        """A formula at the start; with `states` the names of states stay in it, as those of their starts."""

        def put(node: Formula) -> Formula | None:
            if node.head == "time":
                return ZERO
            return self._named(node.name, states) if node.head == "name" else None

        return substituted(formula, put)

    def _named(self, name: str, states: bool) -> Formula | None:
        symbols = self.symbols
        if name in symbols.constants or (states and name in symbols.states and not symbols.states[name].discrete):
            return None
        reaction: Reaction | None = symbols.book.reactions.get(name)
        value = reaction.law if reaction is not None else symbols.starts.get(name)
        if name in self._open:
            symbols.book.report.refuse(*symbols.lines.get(name, (name, 0)), "its start depends on itself")
            return ZERO
        if value is None:
            what, line = symbols.lines.get(name, (name, 0))
            symbols.book.report.refuse(what, line, "it has no value at the start, and another start needs it")
            return ZERO
        self._open.append(name)
        try:
            return self.of(value, states)
        finally:
            self._open.pop()
