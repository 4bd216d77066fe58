"""A model as an SBML document: every quantity is a parameter, every balance a rate rule.

Names, descriptions and units are kept. A network's value is an intermediate of its own, in numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any
from xml.sax.saxutils import escape

import libsbml
import sympy
from sympy.core.function import AppliedUndef

from gbspec.backends import NotCoveredError
from gbspec.diagnostics import ComputationError
from gbspec.exports.sbml.formulas import Infix, Names
from gbspec.exports.sbml.networks import Applications
from gbspec.exports.sbml.units import Units
from gbspec.exports.subject import Exported
from gbspec.ir import Declared, Event, Expr, Lookup, Model

LEVEL, VERSION = 3, 2


class Document:
    """The document of an exported model; quantities may be added before `text` is asked for."""

    def __init__(
        self, exported: Exported, applications: Callable[[Exported, Names], Applications] = Applications
    ) -> None:
        self.exported, self.source = exported, exported.model
        _check(self.source)
        self.document = libsbml.SBMLDocument(LEVEL, VERSION)
        self.model = self.document.createModel()
        self.units = Units(self.model)
        self.names = Names(_names(self.source))
        self.tables: dict[str, str] = {}
        self.printer = Infix(self._symbol, self._table)
        self.applications = applications(exported, self.names)
        self._settings = libsbml.L3ParserSettings()
        self._settings.setParseLog(libsbml.L3P_PARSE_LOG_AS_LN)
        self._settings.setParseModuloL3v2(False)
        self._head()
        self._quantities()
        self._states()
        for event in self.source.events:
            self._event(event)

    # --------------------------------------------------------------------------------------------------- formulas
    def infix(self, value: sympy.Basic) -> str:
        """The formula of an expression; networks are quantities of their own."""
        nodes = value.atoms(AppliedUndef)
        if nodes:
            value = value.xreplace({node: sympy.Symbol(self._applied(node), real=True) for node in nodes})
        return self.printer.print(value)

    def math(self, text: str) -> Any:
        """The tree of a formula."""
        found = libsbml.parseL3FormulaWithSettings(text, self._settings)
        if found is None:
            raise ComputationError(f"libsbml does not read the formula `{text[:80]}`")
        return found

    def _symbol(self, symbol: sympy.Symbol) -> str:
        return "time" if symbol == self.source.time.symbol else self.names(symbol.name)

    def _applied(self, node: Expr) -> str:
        """The name of a quantity with the value of a network's application."""
        known = self.applications.name_of(node)
        if known is None:
            known, steps = self.applications.steps(node, self.printer)
            for name, text in steps:
                self.quantity(name, "", None, formula=text)
        return known

    def _table(self, node: Lookup) -> str:
        """The function of a table, defined when it is first met."""
        if node.table not in self.tables:
            if len(node.curve.knots) != 1 or max(node.order):
                raise NotCoveredError(f"its table `{node.table}` has two arguments")
            self.tables[node.table] = self.names(node.table)
            one = self.model.createFunctionDefinition()
            one.setId(self.tables[node.table])
            one.setMath(self.math(f"lambda(x, {_curve(node)})"))
        return self.tables[node.table]

    # --------------------------------------------------------------------------------------------------- contents
    def _head(self) -> None:
        model, made = self.model, self.exported
        model.setId(self.names.free(self.source.name))
        model.setName(self.source.title or self.source.name)
        lines = [f"{key}: {value}" for key, value in made.origin.items()]
        body = "".join(f"<p>{escape(line)}</p>" for line in lines)
        model.setNotes(f'<notes><body xmlns="http://www.w3.org/1999/xhtml">{body}</body></notes>')
        unit = self.units.of(self.source.time.unit)
        if unit:
            model.setTimeUnits(unit)

    def quantity(
        self, name: str, description: str, unit: str | None, *, value: float | None = None, formula: str | None = None,
        constant: bool = False,
    ) -> Any:  # fmt: skip
        """A parameter: constant, a formula of others, or one that rules and events change."""
        one = self.model.createParameter()
        one.setId(name)
        if description:
            one.setName(description)
        one.setConstant(constant)
        if value is not None and math.isfinite(value):
            one.setValue(value)
        identifier = self.units.of(unit)
        if identifier:
            one.setUnits(identifier)
        if formula is not None:
            rule = self.model.createAssignmentRule()
            rule.setVariable(name)
            rule.setMath(self.math(formula))
        return one

    def declared(self, item: Declared, **more: Any) -> Any:
        """The parameter of something that the model declares."""
        said = item.description or (item.name if self.names(item.name) != item.name else "")
        return self.quantity(self.names(item.name), said, item.unit, **more)

    def start(self, name: str, text: str) -> None:
        """The initial value of a quantity as a formula."""
        one = self.model.createInitialAssignment()
        one.setSymbol(name)
        one.setMath(self.math(text))

    def _quantities(self) -> None:
        source, made = self.source, self.exported
        for item, number in zip((*source.constants, *source.learnables), made.constants, strict=True):
            self.declared(item, value=float(number), constant=True)
        for condition, number in zip(source.conditions, made.conditions, strict=True):
            self.declared(condition, value=float(number), constant=True)
        for given, number in zip(source.inputs, made.inputs, strict=True):
            self.declared(given, value=float(number))
        for item in source.intermediates:
            self.declared(item, formula=self.infix(item.value))

    def _states(self) -> None:
        rows = zip(self.source.states, self.source.balances, self.exported.states, strict=True)
        for state, balance, number in rows:
            name = self.names(state.name)
            known = state.initial.value
            plain = known is None or known.is_number
            self.declared(state, value=float(number if known is None else known) if plain else None)
            if not plain:
                self.start(name, self.infix(known))
            if not state.discrete:
                rule = self.model.createRateRule()
                rule.setVariable(name)
                rule.setMath(self.math(self.infix(balance)))

    def channels(self) -> None:
        """Channels that are no quantities of the model, so that other programs give them too."""
        taken = {*_names(self.source, channels=False)}
        for channel in self.source.channels:
            if channel.name not in taken:
                self.declared(channel, formula=self.infix(channel.value))

    def _event(self, event: Event) -> None:
        one = self.model.createEvent()
        one.setId(self.names(event.name))
        if event.description:
            one.setName(event.description)
        one.setUseValuesFromTriggerTime(False)
        trigger = one.createTrigger()
        trigger.setPersistent(True)
        trigger.setInitialValue(not (event.armed or event.timing is not None))
        values = [(self.names(name), self.infix(value)) for name, value in event.values]
        if event.timing is None:
            trigger.setMath(self.math(self.infix(event.condition)))
        else:
            text, again = self._timed(event)
            trigger.setMath(self.math(text))
            values += again
        if event.rank is not None or event.priority or event.timing is not None:
            text = repr(self._priority(event)) if event.rank is None else self.infix(event.rank)
            one.createPriority().setMath(self.math(text))
        for name, text in values:
            assignment = one.createEventAssignment()
            assignment.setVariable(name)
            assignment.setMath(self.math(text))

    def _priority(self, event: Event) -> float:
        """Of events at one time, timed ones come first, then those that begin a wait, whose priority is infinite; other
        programs, and the import, have finite numbers."""
        given = (abs(one.priority) for one in self.source.events if math.isfinite(one.priority))
        first = max(5e5, 10 * max(given, default=0.0))
        return (event.priority if math.isfinite(event.priority) else first) + (2 * first if event.timing else 0.0)

    def _timed(self, event: Event) -> tuple[str, list[tuple[str, str]]]:
        """The condition of a timed event, and what sets its next time."""
        assert event.timing is not None
        at = repr(self.exported.start) if event.timing.at is None else self.infix(event.timing.at)
        if event.timing.every is None:
            return f"time >= {at}", []
        following = self.names.free(f"{event.name}_next")
        self.quantity(following, f"the next time of {event.name}", self.source.time.unit)
        self.start(following, at)
        text = f"time >= {following}"
        if event.timing.until is not None:
            text = f"({text}) && ({following} <= {self.infix(event.timing.until)})"
        return text, [(following, f"{following} + ({self.infix(event.timing.every)})")]

    # ------------------------------------------------------------------------------------------------------- text
    def text(self) -> str:
        """The document. Raises ComputationError where libsbml finds an error in it."""
        self.document.setConsistencyChecks(libsbml.LIBSBML_CAT_MODELING_PRACTICE, False)
        self.document.checkConsistency()
        for i in range(self.document.getNumErrors()):
            problem = self.document.getError(i)
            if problem.getSeverity() >= libsbml.LIBSBML_SEV_ERROR:
                raise ComputationError(
                    f"the SBML document is not consistent: {' '.join(problem.getMessage().split())}",
                    remedy="please report the model, since this is an error of gbspec",
                )
        return str(libsbml.writeSBMLToString(self.document))


def _names(model: Model, channels: bool = True) -> Iterable[str]:
    groups: list[Iterable[Any]] = [model.states, model.constants, model.learnables, model.conditions, model.inputs]
    groups += [model.intermediates, model.events, model.tables, model.channels if channels else ()]
    for group in groups:
        yield from (item.name for item in group)


def _check(model: Model) -> None:
    """Raises NotCoveredError for what SBML cannot hold, or this export does not."""
    reasons = [
        (bool(model.delays), "it has delays, which SBML has no form for that other programs read"),
        (bool(model.algebraics), "it has algebraic variables, which are not offered in SBML yet"),
        (bool(model.diffusions), "it has random disturbances (`diffusion`), which SBML cannot hold"),
        (bool(model.distributed), "it has constants that are distributed between trajectories (`~`)"),
    ]
    for there, reason in reasons:
        if there:
            raise NotCoveredError(reason)


def _curve(node: Lookup) -> str:
    """A piecewise polynomial of `x`; its ends are held."""
    curve = node.curve
    (knots,), pieces = curve.knots, curve.coefficients
    outside = "NaN" if curve.outside == "error" else None
    first, last = repr(float(curve.values[0])), repr(float(curve.values[-1]))
    parts = [f"{outside or first}, x < {knots[0]!r}"]
    for low, high, row in zip(knots[:-1], knots[1:], pieces, strict=True):
        terms = [f"({float(c)!r})" + f"*(x - ({low!r}))^{p}" * bool(p) for p, c in enumerate(row) if c or not p]
        parts.append(f"{' + '.join(terms)}, x <= {high!r}")
    return f"piecewise({', '.join(parts)}, {outside or last})"
