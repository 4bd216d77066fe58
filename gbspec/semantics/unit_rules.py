"""The units required by each statement, and names whose unit remains undetermined."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import assert_never

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics import noise_units
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.conversions import Conversions, conversion_of, written_number
from gbspec.semantics.dimensions import NEEDS_UNIT, Units
from gbspec.semantics.merge import Item
from gbspec.semantics.processes import Term
from gbspec.semantics.sites import Site
from gbspec.semantics.table import Declaration, Table
from gbspec.semantics.unification import Solution, factor_between
from gbspec.semantics.units import ONE, Namespace, Unit, read
from gbspec.syntax import Kind, ast, normalise, target_name

Terms = Mapping[str, Sequence[tuple[bool, Term]]]
Usable = Callable[[ast.Expression], bool]


def check(
    items: Sequence[Item],
    table: Table,
    order: Sequence[str],
    terms: Terms,
    evaluate: Evaluator,
    usable: Usable,
    sites: Iterable[Site],
    findings: Findings,
) -> Conversions:
    """Checks the units of a model that names any; returns the scales of quantities that are given in units.

    Errors: a name that is not a unit (GB501), operands added or compared in different units (GB502), a unit where a
    pure number is needed (GB503), an expression in another unit than its place (GB504). Warnings: a name whose unit is
    neither declared nor determined by its use (GB550), or is found to mix two units of one quantity (GB551).
    """
    own = frozenset(i.statement.name.text for i in items if isinstance(i.statement, ast.UnitStatement))
    units = Units(table, findings, evaluate, Solution(Namespace(own)))
    rules = _Rules(units, terms, usable)
    by_name = {name: declaration.statement for name, declaration in table.items()}
    items = [item for item in items if not _declared_again(item.statement, by_name)]
    for item in items:
        rules.read(item.statement)
    for name in order:
        rules.named(by_name[name])
    for item in items:
        rules.statement(item.statement)
    for network, place in rules.networks:  # a pure number if its place does not determine it
        if units.solution.known(network) is None:
            units.solution.equal(network, ONE, place)
    if not units.broken:
        _undetermined(units, sites, findings)
        _mixed(units, findings)
    return units.conversions


def _declared_again(statement: ast.Statement, by_name: Mapping[str, ast.Statement | None]) -> bool:
    """Whether an unknown repeats an earlier one's name: already reported, and its arguments may differ."""
    return isinstance(statement, ast.UnknownStatement) and by_name.get(statement.names[0].text) is not statement


class _Rules:
    def __init__(self, units: Units, terms: Terms, usable: Usable) -> None:
        self._units = units
        self._terms = terms
        self._usable = usable
        self.networks: list[tuple[Unit, Span]] = []
        """The units of `nn` in postulates, determined by their places."""

    def read(self, statement: ast.Statement) -> None:
        """Reads the declared units of a statement."""
        units = self._units
        match statement:
            case (
                ast.StateStatement(declarator=declarator, unit=unit)
                | ast.AlgebraicStatement(declarator=declarator, unit=unit)
            ):
                units.declared[declarator.name.text] = units.read(unit, declarator.name.text)
            case ast.ConditionStatement(name=name) if statement.categories is not None:
                units.declared[name.text] = ONE
            case (
                ast.TimeStatement(name=name, unit=unit)
                | ast.ConditionStatement(name=name, unit=unit)
                | ast.InputStatement(name=name, unit=unit)
                | ast.ConstStatement(name=name, unit=unit)
                | ast.LearnStatement(name=name, unit=unit)
                | ast.LetStatement(name=name, unit=unit)
            ):
                units.declared[name.text] = units.read(unit, name.text)
            case ast.UnknownStatement(names=names, arguments=arguments):
                outputs = statement.units if len(statement.units) == len(names) else statement.units * len(names)
                for i, name in enumerate(names):
                    units.declared[name.text] = units.read(outputs[i] if i < len(outputs) else None, name.text)
                units.arguments[names[0].text] = [
                    units.read(a.unit, f"{names[0].text}({a.name.text})") for a in arguments
                ]
                for name in names[1:]:
                    units.arguments[name.text] = units.arguments[names[0].text]
            case ast.TableStatement(name=name, arguments=arguments, unit=unit):
                units.declared[name.text] = units.read(unit, name.text)
                units.arguments[name.text] = [units.read(a.unit, f"{name.text}({a.name.text})") for a in arguments]
            case ast.EffectStatement(name=name):
                units.declared[name.text] = ONE
            case ast.FunctionStatement() | ast.ProcessStatement() | ast.ConserveStatement() | ast.Remark():
                pass  # declare no unit
            case ast.DiscreteStatement() | ast.EventStatement():
                pass  # a discrete value is a state by now
            case ast.CorrelateStatement() | ast.SteadyStatement():
                pass
            case ast.About() | ast.ClosureStatement():
                pass  # use units that others declare
            case _:
                assert_never(statement)

    def named(self, statement: ast.Statement | None) -> None:
        """Checks a constant, function, `let` or rate; to be called after those that it depends on."""
        units = self._units
        match statement:
            case ast.ConstStatement(name=name, value=value):
                self._number(value, name)
            case ast.LetStatement(name=name, value=value):
                if self._usable(value):
                    units.agrees(value, units.of(name.text), f"`{name.text}`", name.span)
            case ast.FunctionStatement(parameters=parameters, value=value):
                if self._usable(value):
                    units.inside_function = True
                    units.expression(value, {p.text: units.solution.fresh() for p in parameters})
                    units.inside_function = False
            case ast.ProcessStatement(name=name, rate=rate):
                if self._usable(rate):
                    units.agrees(rate, units.of(name.text), f"the rate of `{name.text}`", name.span)
            case _:
                pass  # a name that was declared before as something without a value: already reported

    def statement(self, statement: ast.Statement) -> None:
        """Checks the units of any other statement."""
        units = self._units
        match statement:
            case ast.BalanceStatement(target=target, value=value):
                name = target_name(target)
                if self._usable(value):
                    units.agrees(value, units.rate_of(name.text), f"the rate of change of `{name.text}`", name.span)
            case ast.InitialStatement(target=target, value=start) | ast.HistoryStatement(target=target, value=start):
                self._ranged(target_name(target), None, start)
            case ast.ProcessStatement(name=name):
                self._process(name)
            case ast.UnknownStatement():
                self._unknown(statement)
            case ast.ObserveStatement(target=target, value=value, unit=unit):
                channel = self._channel(target_name(target), value, unit)
                noise_units.check(self._units, statement, channel, self._usable)
            case ast.DoseStatement(duration=duration, fraction=fraction, lag=lag):
                self._dose(duration, fraction, lag)
            case ast.DiffusionStatement(target=target, value=value):
                self._diffusion(target_name(target), value)
            case ast.ConserveStatement(value=value, rate=rate):
                self._claim(value, rate)
            case ast.EventStatement():
                self._event(statement)
            case ast.EquationStatement(left=left, right=right):
                self._equation(target_name(statement.target), left, right)
            case ast.SteadyStatement(held=held):
                for one in held:
                    self._ranged(target_name(one.target), None, one.value)
            case (
                ast.StateStatement(declarator=declarator, range=interval, start=start)
                | ast.AlgebraicStatement(declarator=declarator, range=interval, start=start)
            ):
                self._ranged(declarator.name, interval, start)
            case (
                ast.ConditionStatement(name=name, range=interval, default=default)
                | ast.InputStatement(name=name, range=interval, default=default)
            ):
                self._ranged(name, interval, default)
            case ast.LearnStatement(name=name, range=interval, bounds=bounds, start=start):
                self._ranged(name, interval, start, *(bound.value for bound in bounds))
                for grouping in statement.groupings:
                    self._spread(name, grouping)
            case ast.TimeStatement(name=name, start=start):
                self._ranged(name, None, start)
            case ast.ConstStatement() | ast.LetStatement() | ast.FunctionStatement():
                pass  # checked in `named`
            case ast.EffectStatement() | ast.CorrelateStatement() | ast.TableStatement() | ast.DiscreteStatement():
                pass
            case ast.TruthStatement(target=ast.Name() as name, parameters=None, value=value):
                given = conversion_of(value)  # else a truth is in the declared units
                if name.text in units.declared and given is not None and written_number(given.value):
                    units.carries(value, units.of(name.text), f"`{name.text}`", name.span)
            case ast.TruthStatement() | ast.ClosureStatement() | ast.Remark():
                pass
            case _:
                assert_never(statement)

    def _difference(self, unit: Unit) -> Unit:
        return self._units.solution.namespace.difference(self._units.solution.resolved(unit))

    def _time(self) -> Unit:
        return self._units.of(next(d.name for d in self._units.table.values() if d.kind is Kind.TIME))

    def _process(self, name: ast.Name) -> None:
        """Checks that each coefficient times the rate has the unit of a rate of change of its state."""
        units = self._units
        for _, term in self._terms.get(name.text, ()):
            unit = units.of(name.text)
            for inverted, factor in term.factors:
                unit = unit.times(units.expression(factor), Fraction(-1 if inverted else 1))
            if not units.solution.equal(units.rate_of(term.state), unit, term.span):
                units.term_disagrees(name, term.state, term.span, unit)

    def _unknown(self, statement: ast.UnknownStatement) -> None:
        units = self._units
        formals = dict(
            zip((a.name.text for a in statement.arguments), units.arguments[statement.names[0].text], strict=True)
        )
        for i, name in enumerate(statement.names):
            posts = statement.postulates
            post = posts[i] if len(posts) == len(statement.names) else (posts[0] if posts else None)
            if post is not None and self._usable(post):
                network = units.solution.fresh()
                self.networks.append((network, post.span))
                inside = {**formals, "nn": network}
                units.agrees(post, units.of(name.text), f"`{name.text}`", name.span, inside)
        for argument, unit in zip(statement.arguments, formals.values(), strict=True):
            self._interval(argument.range, unit, argument.name)
        for contract in statement.contracts:
            self._contract(contract, statement, formals)

    def _contract(self, contract: ast.Contract, statement: ast.UnknownStatement, formals: Mapping[str, Unit]) -> None:
        units = self._units
        names = [contract.name] if contract.name is not None else statement.names
        for name in names:
            match contract:
                case ast.Bound(value=value):
                    if self._usable(value):
                        units.carries(value, units.of(name.text), f"`{name.text}`", name.span, formals)
                case ast.RangeContract(interval=interval):
                    for end in (interval.low, interval.high):
                        if self._usable(end):
                            units.carries(end, units.of(name.text), f"`{name.text}`", name.span, formals)
                case ast.ZeroAt(argument=argument, value=value):
                    if self._usable(value) and argument.text in formals:
                        units.carries(value, formals[argument.text], f"`{argument.text}`", argument.span, formals)
                case ast.EqualsAt(value=value, argument=argument, place=place):
                    if self._usable(value):
                        units.carries(value, units.of(name.text), f"`{name.text}`", name.span, formals)
                    if self._usable(place) and argument.text in formals:
                        units.carries(place, formals[argument.text], f"`{argument.text}`", argument.span, formals)
                case ast.Periodic(period=period, argument=argument):
                    if self._usable(period) and argument.text in formals:
                        units.carries(period, formals[argument.text], f"`{argument.text}`", argument.span, formals)
                case ast.Shaped():
                    pass
                case _:
                    assert_never(contract)

    def _channel(self, name: ast.Name, value: ast.Expression | None, unit: ast.UnitExpression | None) -> Unit:
        units = self._units
        wanted = units.read(unit, f"channel {name.text}")
        if value is not None and self._usable(value):
            units.agrees(value, wanted, f"the channel `{name.text}`", name.span)
        elif value is None and not units.solution.equal(wanted, units.of(name.text), name.span):
            units.channel_disagrees(name, wanted)
        return wanted

    def _spread(self, name: ast.Name, per: ast.Grouping | None) -> None:
        """Checks the unit of how far values lie apart: that of logarithms has none."""
        if per is None or per.spread is None:
            return
        wanted = self._units.of(name.text) if per.spread.kind.text == "normal" else ONE
        for value in per.spread.arguments:
            if self._usable(value):
                self._units.carries(value, wanted, f"the spread of `{name.text}`", name.span)

    def _dose(
        self, duration: ast.Expression | None, fraction: ast.Expression | None, lag: ast.Expression | None
    ) -> None:
        if duration is not None and self._usable(duration):
            self._units.carries(duration, self._time(), "the duration of an infusion", duration.span)
        if fraction is not None and self._usable(fraction):
            self._units.agrees(fraction, ONE, "the fraction of a dose", fraction.span)
        if lag is not None and self._usable(lag):
            self._units.carries(lag, self._time(), "a lag", lag.span)

    def _diffusion(self, name: ast.Name, value: ast.Expression) -> None:
        """Checks that a disturbance is in units of its state per square root of time."""
        units = self._units
        if self._usable(value):
            wanted = self._difference(units.of(name.text)).times(self._time(), Fraction(-1, 2))
            units.carries(value, wanted, f"the diffusion of `{name.text}`", name.span)

    def _equation(self, name: ast.Name, left: ast.Expression, right: ast.Expression) -> None:
        """Checks that both sides of an equation have one unit; `0` fits anywhere."""
        if self._usable(left) and self._usable(right):
            both = self._units.solution.fresh()
            for side in (left, right):
                self._units.agrees(side, both, f"the other side of `{name.text}`", name.span)

    def _event(self, statement: ast.EventStatement) -> None:
        """Checks the condition of an event, its times, and that each value has the unit of what it sets."""
        units = self._units
        if statement.condition is not None and self._usable(statement.condition):
            units.expression(statement.condition)
        for time in (statement.at, statement.every, statement.until):
            if time is not None and self._usable(time):
                units.carries(time, self._time(), "the time of an event", time.span)
        if statement.after is not None and self._usable(statement.after):
            units.carries(statement.after, self._time(), "the delay of an event", statement.after.span)
        if statement.priority is not None and self._usable(statement.priority):
            units.expression(statement.priority)
        for assignment in statement.assignments:
            name = target_name(assignment.target)
            if name.text in units.table and self._usable(assignment.value):
                units.carries(assignment.value, units.of(name.text), f"`{name.text}`", name.span)

    def _claim(self, value: ast.Expression, rate: ast.Expression | None) -> None:
        if not self._usable(value):
            return
        whole = self._units.expression(value)
        if rate is not None and self._usable(rate):
            per_time = whole.times(self._time(), Fraction(-1))
            self._units.agrees(rate, per_time, "the rate of change of this quantity", value.span)

    def _ranged(self, name: ast.Name, interval: ast.Interval | None, *values: ast.Expression | None) -> None:
        """Checks ranges, starting values, bounds and defaults: pure numbers there are in the declared unit."""
        self._interval(interval, self._units.of(name.text), name)
        for value in values:
            self._number(value, name)

    def _number(self, value: ast.Expression | None, name: ast.Name) -> None:
        if value is not None and self._usable(value):
            self._units.carries(value, self._units.of(name.text), f"`{name.text}`", name.span)

    def _interval(self, interval: ast.Interval | None, unit: Unit, name: ast.Name) -> None:
        for end in (interval.low, interval.high) if interval is not None else ():
            if self._usable(end):
                self._units.carries(end, unit, f"`{name.text}`", name.span)


def check_alone(expressions: Iterable[ast.UnitExpression], findings: Findings) -> None:
    """Checks the unit of the time where no other is named: it must exist (GB501)."""
    for expression in expressions:
        read(expression, Namespace(frozenset()), findings)


def _undetermined(units: Units, sites: Iterable[Site], findings: Findings) -> None:
    used = {name for site in sites for name in site.references.names}
    used.update(d.name for d in units.table.values() if d.kind is Kind.STATE)
    if any(d.kind is Kind.STATE for d in units.table.values()):
        used.update(d.name for d in units.table.values() if d.kind is Kind.TIME)
    told: set[Span] = set()
    for declaration in units.table.values():
        name = declaration.name
        if declaration.kind not in NEEDS_UNIT or name not in used:
            continue
        unit = units.solution.resolved(units.of(name))
        if not unit.unknowns:
            continue
        place = declaration.span if declaration.span is not None else _first_place(units)
        if place is None:  # a time that no line declares, in a model whose units are in lines with errors
            continue
        # Reported here: taken as a pure number, so that units that depend on it are not reported again.
        units.solution.equal(unit, ONE, units.solution.origins.get(name, place))
        for other, _ in unit.unknowns:
            units.solution.solved.setdefault(other, ONE)
        if place not in told:  # several names may be declared by one: elements, and constants of categories
            told.add(place)
            written = _written(declaration)
            findings.warning(
                "GB550",
                f"`{written}` has no unit, and the rest of the model does not determine it",
                place,
                help=_how(written, declaration),
                subject=name if declaration.span is None else normalise(declaration.span.text),
            )


def _written(declaration: Declaration) -> str:
    """A name as its declaration has it: that of the array for an element, and of the constant for one of a category."""
    statement = declaration.statement
    if isinstance(statement, ast.StateStatement | ast.AlgebraicStatement):
        return statement.declarator.span.text
    return declaration.name if declaration.span is None else declaration.span.text


def _mixed(units: Units, findings: Findings) -> None:
    """Warns of names whose unit, found from use, has two units of one quantity, such as `s/h`: a factor is missing.

    One warning for each pair of units: other names usually have it from the same place.
    """
    told: set[frozenset[str]] = set()
    for declaration in units.table.values():
        name = declaration.name
        if declaration.kind not in NEEDS_UNIT or units.of(name) != units.solution.of(name):
            continue
        unit = units.solution.known(units.of(name))
        pair = None if unit is None else units.solution.namespace.mixed(unit)
        if pair is None or frozenset(pair) in told:
            continue
        told.add(frozenset(pair))
        one, other = pair
        found = factor_between(Unit(((one, Fraction(1)),)), Unit(((other, Fraction(1)),)), units.solution.namespace)
        origin = units.solution.origins.get(name)
        findings.warning(
            "GB551",
            f"`{name}` declares no unit, and here it comes out in `{unit}`, which mixes `{one}` and `{other}`",
            declaration.span if declaration.span is not None else _first_place(units),
            labels=[] if origin is None else [Label(origin, "its unit follows from this")],
            notes=[f"1 {one} = {found:g} {other}"],
            help=f"declare the unit of `{name}`, and use one of `{one}` and `{other}` throughout",
            subject=name,
        )


def _first_place(units: Units) -> Span | None:
    """The place at which a time without a statement is reported: the first state."""
    return next((d.span for d in units.table.values() if d.kind is Kind.STATE), None)


def _how(name: str, declaration: Declaration) -> str:
    statement = declaration.statement
    word = "time" if statement is None else statement.entry.word
    arguments = "(…)" if declaration.kind in (Kind.TABLE, Kind.UNKNOWN) else ""
    value = ""
    if isinstance(statement, ast.StateStatement) and statement.span.text.startswith(ast.DiscreteStatement.entry.word):
        word, value = ast.DiscreteStatement.entry.word, " = …"  # written as a state by now
    return f"declare it: `{word} {name}{arguments} : UNIT{value}` (a pure number has the unit `1`)"
