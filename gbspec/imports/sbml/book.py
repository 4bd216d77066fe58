"""What an SBML model says of each of its symbols, as formulas."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

from gbspec.imports.description import Report
from gbspec.imports.formulas import ONE, ZERO, Formula, as_number, named, names, number
from gbspec.imports.sbml.mathml import NotOfferedError, formula_of
from gbspec.imports.sbml.reading import Element


@dataclass(frozen=True)
class Term:
    """A species in a reaction: its coefficient, negative for a reactant, without its conversion factor."""

    species: str
    factor: Formula
    sign: int


@dataclass(frozen=True)
class Reaction:
    """A reaction with its kinetic law in the model's names; None without one."""

    id: str
    law: Formula | None
    terms: tuple[Term, ...]
    element: Element


@dataclass(frozen=True)
class Happening:
    """An event. `armed`: it happens at the start if its trigger is true there; `persistent`: it happens also if its
    trigger ends before; `early`: its values are those when it is triggered; `ranked`: the file gives its priority."""

    id: str
    condition: Formula
    values: Mapping[str, Formula]
    delay: Formula
    priority: Formula
    ranked: bool
    armed: bool
    persistent: bool
    early: bool
    element: Element
    at: Formula | None = None
    """The time, if the condition is that it has come."""

    def formulas(self) -> tuple[Formula, ...]:
        """All its formulas."""
        return (self.condition, self.delay, self.priority, *self.values.values())

    def put(self, change: Callable[[Formula], Formula]) -> Happening:
        """It with all its formulas changed."""
        values = {name: change(value) for name, value in self.values.items()}
        condition, delay, priority = change(self.condition), change(self.delay), change(self.priority)
        return replace(self, condition=condition, values=values, delay=delay, priority=priority)


@dataclass
class Book:
    """A model's symbols: what rules and initial assignments say, the reactions, and the constants of kinetic laws."""

    model: Element
    report: Report
    assigned: dict[str, Formula] = field(default_factory=dict)
    rates: dict[str, Formula] = field(default_factory=dict)
    starts: dict[str, Formula] = field(default_factory=dict)
    reactions: dict[str, Reaction] = field(default_factory=dict)
    events: list[Happening] = field(default_factory=list)
    local: dict[str, tuple[Formula | None, Element]] = field(default_factory=dict)
    """The constants of kinetic laws, under names that the whole model can have."""
    references: dict[str, Element] = field(default_factory=dict)
    """The species references with a name, whose value is their stoichiometry."""
    happening: frozenset[str] = frozenset()
    """What the events of the file set."""

    def math(self, owner: Element, what: str, local: Mapping[str, str] | None = None) -> Formula | None:
        """The formula of an element; None without one, or if it was refused."""
        if not owner.isSetMath():
            self.report.omit(what, owner.getLine(), "it has no formula, and so no effect")
            return None
        try:
            return as_number(formula_of(owner.getMath(), local))
        except NotOfferedError as problem:
            self.report.refuse(what, owner.getLine(), str(problem))
            return ZERO

    def change(self, put: Callable[[Formula], Formula]) -> None:
        """Changes all formulas of the model."""
        for table in (self.assigned, self.rates, self.starts):
            table.update({name: put(formula) for name, formula in table.items()})
        for name, reaction in self.reactions.items():
            terms = tuple(replace(term, factor=put(term.factor)) for term in reaction.terms)
            law = None if reaction.law is None else put(reaction.law)
            self.reactions[name] = replace(reaction, law=law, terms=terms)
        self.events = [one.put(put) for one in self.events]

    def formulas(self) -> Iterable[Formula]:
        """All formulas of the model, with those of kinetic laws."""
        yield from (*self.assigned.values(), *self.rates.values(), *self.starts.values())
        for reaction in self.reactions.values():
            yield from (term.factor for term in reaction.terms)
            if reaction.law is not None:
                yield reaction.law
        for event in self.events:
            yield from event.formulas()

    def event(self, name: str) -> Happening:
        """An event by its name."""
        return next(one for one in self.events if one.id == name)

    def targets(self) -> set[str]:
        """What events set."""
        return {name for event in self.events for name in event.values}

    def referenced(self) -> set[str]:
        """The names in formulas."""
        return set().union(*(names(formula) for formula in self.formulas()))


def read_book(model: Element, report: Report) -> Book:
    """The symbols of a model; what is not offered is refused in the report."""
    assigned = (
        a.getVariable() for e in elements(model.getListOfEvents()) for a in elements(e.getListOfEventAssignments())
    )
    book = Book(model, report, happening=frozenset(assigned))
    _refuse(model, report)
    for rule in elements(model.getListOfRules()):
        variable = rule.getVariable()
        if rule.isAlgebraic():
            report.refuse("algebraicRule", rule.getLine(), "algebraic rules are not offered yet")
            continue
        kind = "assignmentRule" if rule.isAssignment() else "rateRule"
        value = book.math(rule, f"{kind} of {variable}")
        if value is not None:
            (book.assigned if rule.isAssignment() else book.rates)[variable] = value
    for one in elements(model.getListOfInitialAssignments()):
        value = book.math(one, f"initialAssignment of {one.getSymbol()}")
        if value is not None:
            book.starts[one.getSymbol()] = value
    for reaction in elements(model.getListOfReactions()):
        book.reactions[reaction.getId()] = _reaction(book, reaction)
    return book


def elements(found: Element) -> list[Element]:
    """The elements of a list."""
    return [found.get(i) for i in range(found.size())]


def _refuse(model: Element, report: Report) -> None:
    for constraint in elements(model.getListOfConstraints()):
        report.omit(
            "constraint", constraint.getLine(), "constraints are checked by simulators; they change no solution"
        )
    for found, kind in (
        (model.getListOfCompartmentTypes(), "compartmentType"),
        (model.getListOfSpeciesTypes(), "speciesType"),
    ):
        for one in elements(found):
            report.omit(f"{kind} {one.getId()}", one.getLine(), "types change no solution")


def _reaction(book: Book, reaction: Element) -> Reaction:
    name = reaction.getId()
    if (reaction.getLevel() < 3 or reaction.isSetFast()) and reaction.getFast():
        book.report.refuse(f"reaction {name}", reaction.getLine(), "fast reactions are not offered yet")
    law, local = None, {}
    if reaction.isSetKineticLaw():
        kinetic = reaction.getKineticLaw()
        local = _locals(book, name, kinetic)
        law = book.math(kinetic, f"kineticLaw of {name}", local)
    else:
        book.report.omit(f"reaction {name}", reaction.getLine(), "it has no kinetic law, and so no effect")
    terms = []
    for sign, found in ((-1, reaction.getListOfReactants()), (1, reaction.getListOfProducts())):
        for reference in elements(found):
            terms.append(Term(reference.getSpecies(), _factor(book, name, reference), sign))
    return Reaction(name, law, tuple(terms), reaction)


def _locals(book: Book, reaction: str, kinetic: Element) -> dict[str, str]:
    """The constants of a kinetic law: under their own names where no other symbol has them."""
    found = kinetic.getListOfLocalParameters() if kinetic.getLevel() > 2 else kinetic.getListOfParameters()
    table = {}
    for one in elements(found):
        name = one.getId()
        while book.model.getElementBySId(name) is not None or name in book.local:
            name = f"{reaction}_{one.getId()}" if name == one.getId() else f"{name}_"
        table[one.getId()] = name
        book.local[name] = (finite(book.report, f"parameter {name}", one, one.getValue()), one)
    return table


def _factor(book: Book, reaction: str, reference: Element) -> Formula:
    """The coefficient of a species reference."""
    name, what = reference.getId(), f"speciesReference to {reference.getSpecies()} in {reaction}"
    if name:
        book.references[name] = reference
    ruled = name in book.assigned or name in book.rates or name in book.starts or name in book.happening
    if name and ruled:
        return named(name)
    if reference.getLevel() < 3 and reference.isSetStoichiometryMath():
        return book.math(reference.getStoichiometryMath(), what) or ONE
    value = literal_factor(reference)
    if value is None or not math.isfinite(value.value):
        book.report.refuse(what, reference.getLine(), "its stoichiometry has no value")
        return ONE
    return value


def finite(report: Report, what: str, element: Element, value: float) -> Formula | None:
    """The number of an attribute; None for NaN, by which files say that there is none. Infinite ones are refused."""
    if math.isinf(value):
        report.refuse(what, element.getLine(), "a number that is not finite has no form in the language")
        return ZERO
    return None if math.isnan(value) else number(value)


def literal_factor(reference: Element) -> Formula | None:
    """The stoichiometry that a species reference has of itself."""
    if reference.getLevel() < 3:
        below = reference.getDenominator()
        value = reference.getStoichiometry() / (below or 1)
        return number(value) if math.isfinite(value) else None
    value = reference.getStoichiometry()
    return number(value) if reference.isSetStoichiometry() and math.isfinite(value) else None
