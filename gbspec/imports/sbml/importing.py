"""The description of an SBML model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from gbspec.imports.description import Channel, Conversion, Description, Function, Imported, Quantity, Report, Rest
from gbspec.imports.formulas import (
    MOST_NODES,
    ONE,
    ZERO,
    Formula,
    as_number,
    named,
    names,
    number,
    walk,
    without_factor,
)
from gbspec.imports.sbml.book import Happening, Reaction, Term, elements, read_book
from gbspec.imports.sbml.events import add_events, read_events, values_set
from gbspec.imports.sbml.factorials import inlined, to_inline, without_factorials
from gbspec.imports.sbml.mathml import NotOfferedError, formula_of
from gbspec.imports.sbml.reading import Element, omit_notes, read_model
from gbspec.imports.sbml.symbols import Starts, Symbols, described, read_symbols
from gbspec.imports.sbml.units import time_unit
from gbspec.imports.writing import model_name, used_names

CLOCK = "clock"


def import_sbml(path: Path) -> Imported:
    """The description of an SBML file.

    Raises `UserError`: GB894 if it is not read, GB895 with everything in it that the language cannot express."""
    report = Report(str(path))
    document = read_model(path, report)
    try:
        made = described_model(document.getModel(), report, path)
    except RecursionError:
        report.refuse("model", 0, "its formulas depend on one another too deeply")
    report.raise_if_refused()
    return Imported(made, tuple(report.left_out))


@dataclass(frozen=True)
class Change:
    """What another format says of an SBML model: constants in place of some symbols, or besides them; formulas in place
    of some constants, or besides them; other starts; what happens; what is observed (None: everything that can
    change); and a start in a steady state, with what it sets."""

    constants: Mapping[str, Quantity] = field(default_factory=dict)
    assigned: Mapping[str, Formula] = field(default_factory=dict)
    starts: Mapping[str, Formula] = field(default_factory=dict)
    happenings: tuple[Happening, ...] = ()
    channels: tuple[Channel, ...] | None = None
    rest: Rest | None = None


def described_model(model: Element, report: Report, path: Path, change: Change | None = None) -> Description:
    """The description of libsbml's model; what cannot be expressed is refused in the report."""
    change = change or Change()
    book = read_book(model, report)
    read_events(book)
    book.events += change.happenings
    book.starts = {k: v for k, v in book.starts.items() if k not in change.constants and k not in change.assigned}
    book.starts.update(change.starts)
    book.assigned.update(change.assigned)
    functions = _functions(model, report)
    inline = to_inline(functions)
    book.change(lambda formula: inlined(formula, inline))
    symbols = read_symbols(book)
    for added in (change.constants.keys() | change.assigned.keys()) & book.targets():
        report.refuse(*symbols.place(added), "events change it, and the problem sets it, which is not offered yet")
    for added, quantity in change.constants.items():
        known = symbols.constants.get(added)
        symbols.constants[added] = quantity if known is None else replace(quantity, unit=known.unit)
        symbols.starts[added] = quantity.value
    for added, formula in change.assigned.items():
        if added not in symbols.lines:
            symbols.intermediates[added] = Quantity(added, inlined(formula, inline))
            symbols.starts[added] = symbols.intermediates[added].value
    name = model.getId() or path.stem
    out = Description(model_name(name), title=model.getName() or name, source=path.name)
    out.time_unit = time_unit(model)
    out.units = {"item": "number of things"}
    out.functions = [replace(f, value=inlined(f.value, inline)) for f in functions if f.id not in inline]
    _reactions(symbols, out)
    for state, rate in book.rates.items():
        out.balances[state] = rate
    _quantities(symbols, out)
    if change.rest is not None:
        out.rest = replace(change.rest, after=values_set(symbols, dict(change.rest.after)))
    add_events(symbols, out, {f.id: f for f in functions})
    out.channels = _channels(symbols) if change.channels is None else list(change.channels)
    _with_clock(out, report, model.getLine())
    without_factorials(out, report, symbols.place)
    _check(symbols, out)
    omit_notes(report, model)
    return out


def _functions(model: Element, report: Report) -> list[Function]:
    found = []
    for one in elements(model.getListOfFunctionDefinitions()):
        what = f"functionDefinition {one.getId()}"
        if not one.isSetMath() or one.getBody() is None:
            report.omit(what, one.getLine(), "it has no formula, and so no effect")
            continue
        arguments = tuple(one.getArgument(i).getName() for i in range(one.getNumArguments()))
        try:
            body = as_number(formula_of(one.getBody()))
        except NotOfferedError as problem:
            report.refuse(what, one.getLine(), str(problem))
            continue
        found.append(Function(one.getId(), arguments, body, described(one)))
    return found


# ------------------------------------------------------------------------------------------------------ reactions
def _reactions(symbols: Symbols, out: Description) -> None:
    referenced = symbols.book.referenced()
    for reaction in symbols.book.reactions.values():
        if reaction.law is None:
            continue
        terms = [t for t in reaction.terms if symbols.reacts(t.species)]
        if not terms:
            _without_effect(symbols, out, reaction, reaction.id in referenced)
        elif all(_is_constant(symbols, term.factor) for term in terms):
            out.conversions.append(_conversion(symbols, reaction, terms, reaction.id in referenced))
        else:
            _as_balances(symbols, out, reaction, terms)


def _without_effect(symbols: Symbols, out: Description, reaction: Reaction, referenced: bool) -> None:
    if referenced:
        out.intermediates.append(Quantity(reaction.id, reaction.law, described(reaction.element)))
    else:
        reason = "it changes no species: each is constant, or a boundary"
        symbols.book.report.omit(f"reaction {reaction.id}", reaction.element.getLine(), reason)


def _is_constant(symbols: Symbols, formula: Formula) -> bool:
    return names(formula) <= symbols.constants.keys() and not any(node.head == "time" for node in walk(formula))


def _conversion(symbols: Symbols, reaction: Reaction, terms: list[Term], referenced: bool) -> Conversion:
    """A reaction as a process. Its rate is that of amounts; if all species are concentrations in one compartment, and
    nothing else needs the rate, it is divided by the compartment, which is often a factor of the kinetic law."""
    assert reaction.law is not None
    divisors = {symbols.divisors.get(term.species) for term in terms}
    law, shared = reaction.law, None
    if len(divisors) == 1 and not referenced and (shared := next(iter(divisors))) is not None:
        law = _divided(law, shared)
    sides: tuple[list[tuple[Formula, str]], list[tuple[Formula, str]]] = ([], [])
    for species, factor, sign in _merged(symbols, terms):
        divisor = symbols.divisors.get(species)
        coefficient = factor if divisor is None or shared is not None else Formula("/", (factor, named(divisor)))
        sides[sign > 0].append((coefficient, symbols.state_of(species)))
    return Conversion(reaction.id, tuple(sides[0]), tuple(sides[1]), law, described(reaction.element))


def _divided(law: Formula, compartment: str) -> Formula:
    return without_factor(law, compartment) or Formula("/", (law, named(compartment)))


def _merged(symbols: Symbols, terms: list[Term]) -> list[tuple[str, Formula, int]]:
    """Species with their coefficients, conversion factors included; repeated ones of a side added."""
    found: dict[tuple[str, int], Formula] = {}
    for term in terms:
        factor, sign = term.factor, term.sign
        if factor.head == "number" and factor.value < 0:
            factor, sign = number(-factor.value), -sign
        if factor == ZERO:
            continue
        factor = _converted(symbols, term.species, factor)
        key = (term.species, sign)
        before = found.get(key)
        if before is not None and before.head == factor.head == "number":
            factor = number(before.value + factor.value)
        elif before is not None:
            factor = before + factor
        found[key] = factor
    return [(species, factor, sign) for (species, sign), factor in found.items()]


def _converted(symbols: Symbols, species: str, factor: Formula) -> Formula:
    model = symbols.book.model
    element = model.getSpecies(species)
    name = ""
    if model.getLevel() > 2:
        name = element.getConversionFactor() or model.getConversionFactor()
    return factor * named(name) if name else factor


def _as_balances(symbols: Symbols, out: Description, reaction: Reaction, terms: list[Term]) -> None:
    """A reaction whose coefficients change: its rate as an intermediate, and a part in the balance of each species."""
    out.intermediates.append(Quantity(reaction.id, reaction.law, described(reaction.element)))
    for term in terms:
        state, divisor = symbols.state_of(term.species), symbols.divisors.get(term.species)
        part = _converted(symbols, term.species, term.factor) * named(reaction.id)
        part = part if divisor is None else Formula("/", (part, named(divisor)))
        before = out.balances.get(state, ZERO)
        out.balances[state] = before + part if term.sign > 0 else before - part


# ----------------------------------------------------------------------------------------------------- quantities
def _quantities(symbols: Symbols, out: Description) -> None:
    starts, needed = Starts(symbols), _needed(symbols, out)
    for one in symbols.states.values():
        reacting = any(one.id == state for c in out.conversions for _, state in (*c.consumed, *c.produced))
        if not one.discrete and not reacting:
            out.balances.setdefault(one.id, ZERO)  # it stands in reactions with the coefficient 0
        value = None if one.value is None else starts.of(one.value, states=not one.discrete)
        if value is None:
            symbols.book.report.refuse(*symbols.lines[one.id], "it has no value at the start")
        out.states.append(replace(one, value=value))
        needed |= names(value) if value is not None else set()
    out.intermediates = [*symbols.intermediates.values(), *out.intermediates]
    values = {
        name: None if one.value is None else starts.of(one.value, states=False)
        for name, one in symbols.constants.items()
    }
    needed |= set().union(*(names(value) for value in values.values() if value is not None))
    for name, one in symbols.constants.items():
        value = values[name]
        if value is not None or one.condition:
            out.constants.append(replace(one, value=value))
        elif name in needed:
            symbols.book.report.refuse(*symbols.lines[name], "it has no value")
        else:
            symbols.book.report.omit(*symbols.lines[name], "it has no value, and nothing needs one")


def _needed(symbols: Symbols, out: Description) -> set[str]:
    return used_names(out) | set().union(
        *(names(q.value) for q in symbols.intermediates.values() if q.value is not None)
    )


def _channels(symbols: Symbols) -> list[Channel]:
    """Everything that can change, and the constants that an initial assignment computes."""
    model, found = symbols.book.model, []
    lists = (model.getListOfSpecies(), model.getListOfCompartments(), model.getListOfParameters())
    for element in (e for one in lists for e in elements(one)):
        name = element.getId()
        known = symbols.starts.get(name) is not None or name in symbols.book.assigned
        if known and (not element.getConstant() or name in symbols.book.starts or name in symbols.intermediates):
            found.append(Channel(name, named(name), name))
    for name in symbols.book.references:
        if name not in symbols.constants:
            found.append(Channel(name, named(name), name))
    if not found:  # a model of constants alone
        found = [Channel(name, named(name), name) for name, value in symbols.starts.items() if value is not None]
    return found


def _with_clock(out: Description, report: Report, line: int) -> None:
    """A model in which nothing has a balance gets a state: the language has no models without one."""
    if any(not one.discrete for one in out.states):
        return
    taken = used_names(out) | {q.id for q in (*out.constants, *out.intermediates, *out.states)}
    taken |= {event.id for event in out.events}
    name = CLOCK
    while name in taken:
        name += "_"
    out.states.append(Quantity(name, ZERO, "time since the start; the model has no variable with a balance"))
    out.balances[name] = ONE
    report.omit("model", line, f"nothing in it has a balance; the state `{name}` was added, since a model needs one")


def _check(symbols: Symbols, out: Description) -> None:
    """Refuses names that nothing declares, formulas that are too large, and a model without channels."""
    known = {*symbols.constants, *symbols.states, *symbols.intermediates, *symbols.book.reactions}
    known |= {f.id for f in out.functions} | {q.id for q in out.states}
    known |= {one.id for one in out.channels}
    known |= {argument for f in out.functions for argument in f.arguments}
    for name in sorted(used_names(out) - known):
        symbols.book.report.refuse(f"symbol {name}", 0, "nothing declares it")
    size = sum(1 for q in (*out.constants, *out.states) if q.value is not None for _ in walk(q.value))
    if size > MOST_NODES:
        symbols.book.report.refuse("model", 0, "the formulas of its starts are too large")
    if not out.channels:
        symbols.book.report.refuse("model", 0, "nothing in it can change")
