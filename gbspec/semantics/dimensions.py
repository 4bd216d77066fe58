"""The units of a model's names and expressions: sums, calls, balances, processes. Skipped if no unit is named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.conversions import Conversions, Scale, between, conversion_of, written_number
from gbspec.semantics.delays import is_delay
from gbspec.semantics.expressions import chain, fold, operands, walk
from gbspec.semantics.table import Table
from gbspec.semantics.unification import UNKNOWN, Solution, factor_between
from gbspec.semantics.unit_remedies import excerpt, made_absolute, made_pure, of_bare_number, remedy
from gbspec.semantics.units import ONE, Unit, read
from gbspec.syntax import FUNCTIONS, Kind, ast

_SAME = frozenset({"abs", "mod", "min", "max"})
_HALF = Fraction(1, 2)
_ADDED = "are added or subtracted"

NEEDS_UNIT = frozenset(
    {
        Kind.TIME,
        Kind.STATE,
        Kind.ALGEBRAIC,
        Kind.CONDITION,
        Kind.INPUT,
        Kind.CONST,
        Kind.LEARN,
        Kind.TABLE,
        Kind.UNKNOWN,
    }
)
"""The kinds that should declare a unit in a model with units; the units of `let`s and rates follow from them."""

Formals = Mapping[str, Unit]


@dataclass
class Units:
    """The units of a model's names, and those of its expressions."""

    table: Table
    findings: Findings
    evaluate: Evaluator
    solution: Solution
    declared: dict[str, Unit] = field(default_factory=dict)
    arguments: dict[str, list[Unit]] = field(default_factory=dict)
    reported: set[tuple[int, int]] = field(default_factory=set)
    conversions: Conversions = field(default_factory=Conversions)
    inside_function: bool = False
    broken: bool = False
    _unread: bool = False
    """Whether a declared unit does not exist: what follows from that is not reported."""
    _within: list[Span] = field(default_factory=list)
    """The calls whose function bodies are being checked, outermost first."""
    _calls: dict[tuple[str, tuple[Unit, ...]], Unit] = field(default_factory=dict)

    # ------------------------------------------------------------------------------------------------------- reading

    def read(self, unit: ast.UnitExpression | None, name: str) -> Unit:
        """The declared unit, or the undetermined unit of the name."""
        if unit is not None:
            found = read(unit, self.solution.namespace, self.findings)
            if found is not None:
                return found
            self.broken = self._unread = True
            return self.solution.fresh()
        return self.solution.of(name)

    def of(self, name: str) -> Unit:
        """The unit of a declared name."""
        return self.declared.setdefault(name, self.solution.of(name))

    # --------------------------------------------------------------------------------------------------- expressions

    def expression(self, node: ast.Expression, formals: Formals | None = None) -> Unit:
        """The unit of an expression; disagreements inside are reported."""
        shadow = formals or {}
        return fold(node, lambda part, units: self._combine(part, units, shadow), _parts)

    def _combine(self, node: ast.Expression, units: Sequence[Unit], formals: Formals) -> Unit:
        match node:
            case ast.Number():
                return self.solution.fresh() if node.value == 0 else ONE
            case ast.Name(text=text):
                return self._name(node, formals) if text != "pi" else ONE
            case ast.Group() | ast.Unary(operator="-" | "+"):
                return units[0]
            case ast.Unary() | ast.Logic():
                return ONE
            case ast.Comparison(left=left, right=right):
                self.same([left, right], units, "are compared")
                return ONE
            case ast.Conditional(then=then, otherwise=otherwise):
                return self.same([then, otherwise], units[1:], "are the two values of an `if`")
            case ast.Binary(operator="^"):
                return self._power(node, units[0], units[1])
            case ast.Binary(operator="+" | "-"):
                return self._sum(chain(node), units)
            case ast.Conversion():
                return self._converted(node, units[0])
            case ast.Binary():
                return self._product(node, units)
            case ast.Call():
                return self._call(node, units, formals)
            case _:
                return self.solution.fresh()

    def _name(self, node: ast.Name, formals: Formals) -> Unit:
        if node.text in formals:
            return formals[node.text]
        declaration = self.table.get(node.text)
        if declaration is not None and isinstance(declaration.statement, ast.UnknownStatement):
            names = [ast.Name(node.span, a.name.text) for a in declaration.statement.arguments]
            unknown = declaration.statement
            self._apply(unknown.names[0].text, unknown.arguments, names, [self._name(n, formals) for n in names])
        return self.of(node.text)

    def same(self, nodes: Sequence[ast.Expression], units: Sequence[Unit], how: str) -> Unit:
        """The common unit of several operands; a new unknown unit if one differs from the first (reported)."""
        agreed = True
        for node, unit in zip(nodes[1:], units[1:], strict=True):
            if not self.solution.equal(units[0], unit, node.span):
                agreed = False
                self._disagree(nodes[0], units[0], node, unit, how)
        return units[0] if agreed else self.solution.fresh()

    def _sum(self, parts: Sequence[tuple[bool, ast.Expression]], units: Sequence[Unit]) -> Unit:
        """The unit of a sum: where as many temperatures of a scale are subtracted as added, that of a difference."""
        namespace = self.solution.namespace
        resolved = [self.solution.resolved(unit) for unit in units]
        scales = [namespace.is_scale(unit.lone()) for unit in resolved]
        net = sum(-1 if minus else 1 for (minus, _), scale in zip(parts, scales, strict=True) if scale)
        if any(scales) and net == 0:
            units = [namespace.difference(unit) for unit in resolved]
        common = self.same([part for _, part in parts], units, _ADDED)
        agreed = common is units[0]  # what disagrees is reported once
        return resolved[scales.index(True)] if any(scales) and net and agreed else common

    def _converted(self, node: ast.Conversion, unit: Unit) -> Unit:
        """The unit of a quantity that is given in one; its scale is noted, and what cannot be converted reported."""
        wanted = read(node.unit, self.solution.namespace, self.findings)
        if wanted is None:
            self.broken = self._unread = True
        elif written_number(node.value):
            self.conversions.note(node, Scale())
            return wanted
        elif self.inside_function:
            self._not_converted(node, "GB789", "the units of a function's arguments are those of each call")
        elif (found := self.solution.known(unit)) is None:
            self._not_converted(node, "GB789", "the unit of what is to be converted is not known here")
        elif (scale := between(found, wanted, self.solution.namespace)) is None:
            a, b = self.solution.shown(found), self.solution.shown(wanted)
            self._not_converted(node, "GB788", f"a quantity in `{a}` cannot be given in `{b}`")
        elif self.conversions.note(node, scale):
            return wanted
        else:
            self._not_converted(node, "GB789", "this would be converted from different units")
        self.conversions.note(node, None)
        return self.solution.fresh()

    def _not_converted(self, node: ast.Conversion, code: str, message: str) -> None:
        help = {"GB788": "units of one kind can be converted, as `m` and `km`"}.get(
            code, "declare the units of the names in it; where a function is called, convert its arguments"
        )
        if self._once(node.span, node.unit.span):
            self.findings.error(code, message, node.span, help=help)

    def _product(self, node: ast.Binary, units: Sequence[Unit]) -> Unit:
        result = ONE
        for (inverted, _), unit in zip(chain(node), units, strict=True):
            result = result.times(unit, Fraction(-1 if inverted else 1))
        return result

    def _power(self, node: ast.Binary, base: Unit, exponent: Unit) -> Unit:
        self.pure(node.right, exponent, "an exponent")
        value = self.evaluate(node.right)
        if value is not None:
            return base.power(Fraction(value).limit_denominator(1000))
        self.pure(node.left, base, "the base of a power whose exponent varies")
        return ONE

    def pure(self, node: ast.Expression, unit: Unit, what: str) -> None:
        """Reports an expression that must be a pure number and is not."""
        if not self.solution.equal(unit, ONE, node.span) and self._once(node.span, node.span):
            self.findings.error(
                "GB503",
                f"{what} is a pure number, but this has the unit `{self.solution.shown(unit)}`",
                node.span,
                label=f"in `{self.solution.shown(unit)}`",
                labels=self._origins(unit),
                help=self._absolute(node, unit) or made_pure(self.solution, node, unit, not self.inside_function),
            )

    def _absolute(self, node: ast.Expression, unit: Unit) -> str:
        """The help where a temperature in a scale with a zero of its own stands in a product with absolute ones."""
        texts = [part.text for part in walk(node) if isinstance(part, ast.Name) and part.text in self.table]
        named = [] if self.inside_function else [(text, self.of(text)) for text in texts]
        return made_absolute(self.solution, unit, named)

    # --------------------------------------------------------------------------------------------------------- calls

    def _call(self, node: ast.Call, units: Sequence[Unit], formals: Formals) -> Unit:
        name = node.function.text
        if name == "net":
            state = node.arguments[0]
            return self.rate_of(state.text) if isinstance(state, ast.Name) else self.solution.fresh()
        declaration = self.table.get(name)
        match declaration.statement if declaration is not None else None:
            case ast.FunctionStatement() as function:
                return self._written_out(function, units, node.span)
            case ast.UnknownStatement() as unknown:
                self._apply(unknown.names[0].text, unknown.arguments, node.arguments, units)
                return self.of(name)
            case ast.TableStatement(arguments=arguments):
                self._apply(name, arguments, node.arguments, units)
                return self.of(name)
            case _:
                return self._elementary(node, units)

    def _elementary(self, node: ast.Call, units: Sequence[Unit]) -> Unit:
        name = node.function.text
        if is_delay(node, self.table) and len(units) == 2:
            return self._delayed(node, units)
        if name not in FUNCTIONS:
            return self.solution.fresh()
        if name in _SAME:
            return self.same(node.arguments, units, f"are arguments of `{name}`")
        if name == "sqrt":
            return units[0].power(_HALF)
        if name == "atan2":
            self.same(node.arguments, units, "are arguments of `atan2`")
        elif name != "sign":
            self.pure(node.arguments[0], units[0], f"the argument of `{name}`")
        return ONE

    def _delayed(self, node: ast.Call, units: Sequence[Unit]) -> Unit:
        """The unit of what is delayed; a pure number is a time in the model's unit."""
        lag = node.arguments[1]
        time = self.of(next((d.name for d in self.table.values() if d.kind is Kind.TIME), "t"))
        named = any(isinstance(part, ast.Name) and part.text != "pi" for part in walk(lag))
        if named and not self.solution.equal(time, units[1], lag.span) and self._once(lag.span, node.span):
            self._mismatch("a delay", lag.span, time, lag, units[1])
        return units[0]

    def _written_out(self, function: ast.FunctionStatement, units: Sequence[Unit], place: Span) -> Unit:
        key = (function.name.text, tuple(self.solution.resolved(u) for u in units))
        if key not in self._calls:
            formals = dict(zip((p.text for p in function.parameters), units, strict=True))
            self._within.append(place)
            outside, self.inside_function = self.inside_function, True
            self._calls[key] = self.expression(function.value, formals)
            self.inside_function = outside
            self._within.pop()
        return self._calls[key]

    def _apply(
        self, name: str, arguments: Sequence[ast.Argument], nodes: Sequence[ast.Expression], units: Sequence[Unit]
    ) -> None:
        """Checks the units of the arguments of an unknown or a table."""
        for argument, formal, node, unit in zip(arguments, self.arguments[name], nodes, units, strict=True):
            if not self.solution.equal(formal, unit, node.span) and self._once(node.span, argument.span):
                self._mismatch(
                    f"the argument `{argument.name.text}` of `{name}`",
                    argument.span,
                    formal,
                    node,
                    unit,
                )

    # ------------------------------------------------------------------------------------------------- whole statements

    def rate_of(self, state: str) -> Unit:
        """The unit of a state's rate of change."""
        time = next((d.name for d in self.table.values() if d.kind is Kind.TIME), "t")
        changing = self.solution.namespace.difference(self.solution.resolved(self.of(state)))
        return changing.times(self.of(time), Fraction(-1))

    def agrees(self, node: ast.Expression, wanted: Unit, what: str, at: Span, formals: Formals | None = None) -> None:
        """Reports an expression whose unit is not `wanted`."""
        unit = self.expression(node, formals)
        if not self.solution.equal(wanted, unit, node.span) and self._once(node.span, at):
            self._mismatch(what, at, wanted, node, unit)

    def carries(self, node: ast.Expression, wanted: Unit, what: str, at: Span, formals: Formals | None = None) -> None:
        """Like `agrees`, but a number is taken to be in the wanted unit, or converted to it from the one given."""
        given = conversion_of(node)
        if given is not None and written_number(given.value):
            self._number_in(given, wanted, what, at)
        elif any(isinstance(part, ast.Conversion) for part in walk(node)) or any(
            isinstance(part, ast.Name) and part.text != "pi" for part in walk(node)
        ):
            self.agrees(node, wanted, what, at, formals)

    def _number_in(self, node: ast.Conversion, wanted: Unit, what: str, at: Span) -> None:
        unit = self.expression(node)
        known = self.solution.known(wanted)
        if known is None:
            self.solution.equal(wanted, unit, node.span)
            return
        scale = between(unit, known, self.solution.namespace)
        if scale is not None:
            self.conversions.put(node, scale)
        elif self._once(node.span, at):
            self._mismatch(what, at, known, node, unit)

    def term_disagrees(self, process: ast.Name, state: str, span: Span, unit: Unit) -> None:
        """Reports a term of a process whose coefficient does not fit the rate."""
        wanted = self.rate_of(state)
        if self._once(span, process.span):
            a, b = self.solution.shown(wanted), self.solution.shown(unit)
            rate = self.solution.shown(self.of(process.text))
            self.findings.error(
                "GB504",
                f"`{state}` changes in `{a}`, but this coefficient times the rate of `{process.text}` is in `{b}`",
                span,
                label=f"in `{b}` with the rate",
                labels=[Label(process.span, f"its rate is in `{rate}`"), *self._origins(unit, wanted)],
                help=self._remedy(wanted, unit, span),
            )

    def channel_disagrees(self, name: ast.Name, wanted: Unit) -> None:
        """Reports a channel whose declared unit differs from that of its expression."""
        unit = self.of(name.text)
        if self._once(name.span, name.span):
            a, b = self.solution.shown(wanted), self.solution.shown(unit)
            factor = factor_between(
                self.solution.resolved(unit), self.solution.resolved(wanted), self.solution.namespace
            )
            self.findings.error(
                "GB504",
                f"the channel `{name.text}` is in `{a}`, but what it measures is in `{b}`",
                name.span,
                help="units are never converted implicitly"
                + (f"; write `observe {name.text}_converted = {name.text} in {a}`" if factor else ""),
            )

    # ----------------------------------------------------------------------------------------------------- reporting

    def _once(self, first: Span, second: Span) -> bool:
        key = (first.start, second.start)
        self.broken = True
        if key in self.reported:
            return False
        self.reported.add(key)
        return True

    def _follows(self, *shown: str) -> bool:
        """Whether one of the units that disagree is not known because its declaration could not be read."""
        return self._unread and UNKNOWN in shown

    def _disagree(self, first: ast.Expression, one: Unit, second: ast.Expression, other: Unit, how: str) -> None:
        a, b = self.solution.shown(one), self.solution.shown(other)
        if not self._once(first.span, second.span) or self._follows(a, b):
            return
        self.findings.error(
            "GB502",
            f"`{excerpt(first)}` in `{a}` and `{excerpt(second)}` in `{b}` {how}",
            second.span,
            label=f"in `{b}`",
            labels=[Label(first.span, f"in `{a}`"), *self._origins(other, one)],
            help=of_bare_number(self.solution, first, one, second, other, how == _ADDED)
            or self._remedy(one, other, second),
        )

    def _mismatch(self, what: str, at: Span, wanted: Unit, node: ast.Expression, unit: Unit) -> None:
        a, b = self.solution.shown(wanted), self.solution.shown(unit)
        if self._follows(a, b):
            return
        given = conversion_of(node)  # in a third unit: the last one is what counts
        inner = node if given is None or written_number(given.value) else given.value
        self.findings.error(
            "GB504",
            f"{what} is in `{a}`, but this is in `{b}`",
            node.span,
            label=f"in `{b}`",
            labels=[Label(at, f"in `{a}`"), *self._origins(unit, wanted)],
            help=self._inverted(wanted, unit, node) or self._remedy(wanted, unit, inner),
        )

    def _inverted(self, wanted: Unit, unit: Unit, node: ast.Expression) -> str:
        """The help if a constant that converts units stands the wrong way round: one more factor would hide that."""
        namespace = self.solution.namespace
        for part in walk(node):
            name = part.text if isinstance(part, ast.Name) else ""
            declared = self.solution.known(self.of(name)) if name in self.table else None
            if declared is None or self.table[name].kind is not Kind.CONST or declared == ONE:
                continue
            for power, word in ((2, "multiply by"), (-2, "divide by")):
                ratio = self.solution.known(wanted.times(unit.times(declared, Fraction(power)), Fraction(-1)))
                converts = factor_between(declared, ONE, namespace) is not None
                if converts and ratio is not None and namespace.is_one(ratio):
                    return f"`{name}`, which converts units by `{declared}`, is the wrong way round: {word} it"
        return ""

    def _remedy(self, wanted: Unit, unit: Unit, what: ast.Expression | Span) -> str:
        return remedy(self.solution, wanted, unit, what, not self.inside_function)

    def _origins(self, *units: Unit) -> list[Label]:
        """The places at which undeclared units of names were inferred."""
        labels = [Label(self._within[0], "in this call")] if self._within else []
        for unit in units:
            for name, _ in unit.unknowns:
                span = self.solution.origins.get(name)
                if span is not None and name in self.table and self.table[name].kind in NEEDS_UNIT:
                    value = self.solution.shown(self.solution.of(name))
                    labels.append(Label(span, f"`{name}` declares no unit; from here it is `{value}`"))
        return labels[:4]


def _parts(node: ast.Expression) -> tuple[ast.Expression, ...]:
    net = isinstance(node, ast.Call) and node.function.text == "net"
    return () if net else operands(node)
