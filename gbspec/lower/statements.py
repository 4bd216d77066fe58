"""Lowers the statements of a checked file to a Model.

Function calls are expanded (once per distinct call); `let`s and process rates stay symbols.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import cast

import sympy

from gbspec.diagnostics import Findings
from gbspec.ir import NOISES, Expr, Noise, NoiseKind, deviation_of_counts, lookup, symbol, unknown_function
from gbspec.ir import PREDICTION as PREDICTED
from gbspec.ir import model as ir
from gbspec.lower import algebraic, events, populations, steady, tables
from gbspec.lower.contracts import contract_values, lower_contracts
from gbspec.lower.delays import Delays
from gbspec.lower.disturbances import disturbance, refuse_together
from gbspec.lower.expressions import build, is_finite, power
from gbspec.lower.infusions import infused, refuse_elements
from gbspec.lower.short import ShortForms, places_of
from gbspec.lower.small import neutral, string, time_of, unit_text
from gbspec.semantics import (
    SUBJECT,
    Checked,
    Term,
    default_start,
    is_delay,
    network_activation,
    network_widths,
    spline_sizes,
    truth_parameters,
)
from gbspec.syntax import PREDICTION, Kind, ast, target_name


def lower(checked: Checked, findings: Findings) -> ir.Model:
    """The Model of a checked file.

    Records an error (GB223) if an expression simplifies to a non-finite number; the Model must then not be used.
    """
    return _Lowering(checked, findings).model()


class _Lowering:
    def __init__(self, checked: Checked, findings: Findings) -> None:
        self._checked = checked
        self._table = checked.table
        self._findings = findings
        self._inlined_calls: dict[tuple[str, tuple[Expr, ...]], Expr] = {}
        self._nets: dict[str, Expr] = {}
        self._stoichiometry: dict[str, tuple[tuple[str, Expr], ...]] = {}
        self._delays = Delays(findings)
        self._fixed_lets: dict[sympy.Symbol, Expr] = {}
        self._short = ShortForms(checked, self._build)
        self._tables = {table.name: table for table in tables.lowered(checked)}
        self._position_of = {s.declarator.name.text: i for i, s in enumerate(checked.all(ast.StateStatement))}

    # ----------------------------------------------------------------------------------------------------- expressions

    def _expression(self, node: ast.Expression, formals: Mapping[str, Expr] | None = None) -> Expr:
        result = self._build(node, formals or {})
        if not is_finite(result):
            self._findings.error(
                "GB223",
                "this is not a finite number for any values of its variables",
                node.span,
                label=f"simplifies to `{result}`" if result.is_Atom else "",
            )
            return sympy.S.Zero
        return result

    def _build(self, node: ast.Expression, formals: Mapping[str, Expr]) -> Expr:
        def naming(name: ast.Name) -> Expr:
            return self._name(name.text, formals)

        def calling(call: ast.Call, arguments: Sequence[Expr]) -> Expr:
            return self._call(call, tuple(arguments))

        return build(node, naming, calling, self._short.indexing)

    def _name(self, name: str, formals: Mapping[str, Expr]) -> Expr:
        if name in formals:
            return formals[name]
        declaration = self._table.get(name)
        if declaration is not None and isinstance(declaration.statement, ast.UnknownStatement):
            arguments = (self._name(a.name.text, formals) for a in declaration.statement.arguments)
            return unknown_function(name)(*arguments)
        return symbol(name)

    def _call(self, call: ast.Call, arguments: tuple[Expr, ...]) -> Expr:
        name = call.function.text
        if name == "net":
            state = call.arguments[0]
            if isinstance(state, ast.Index):
                return self._net(self._short.name_of(state, self._build(state.index, {})))
            return self._net(state.text if isinstance(state, ast.Name) else "")
        if name == "sum":
            return self._short.total(call)
        if is_delay(call, self._table):
            return self._delays.symbol(call, *arguments)
        statement = self._table[name].statement
        if isinstance(statement, ast.TableStatement):
            return lookup(name, self._tables[name].curve)(*arguments)
        if not isinstance(statement, ast.FunctionStatement):
            return unknown_function(name)(*arguments)
        key = (name, arguments)
        if key not in self._inlined_calls:
            formals = {p.text: value for p, value in zip(statement.parameters, arguments, strict=True)}
            self._inlined_calls[key] = self._build(statement.value, formals)
        return self._inlined_calls[key]

    def _net(self, state: str) -> Expr:
        """The sum of all processes' contributions to a state's rate of change."""
        if not self._nets:
            parts: dict[str, list[Expr]] = {name: [] for name, d in self._table.items() if d.kind is Kind.STATE}
            for process in self._checked.all(ast.ProcessStatement):
                for name, coefficient in self._coefficients(process.name.text):
                    parts[name].append(coefficient * symbol(process.name.text))
            self._nets = {name: sympy.Add(*terms) for name, terms in parts.items()}
        return self._nets[state]

    def _coefficients(self, process: str) -> tuple[tuple[str, Expr], ...]:
        if process not in self._stoichiometry:
            sums: dict[str, list[Expr]] = {}
            for consumed, term in self._checked.terms.get(process, ()):
                value = self._coefficient(term)
                sums.setdefault(term.state, []).append(-value if consumed else value)
            self._stoichiometry[process] = tuple((name, sympy.Add(*values)) for name, values in sums.items())
        return self._stoichiometry[process]

    def _coefficient(self, term: Term) -> Expr:
        factors = [
            power(self._fixed(factor), sympy.S.NegativeOne) if inverted else self._fixed(factor)
            for inverted, factor in term.factors
        ]
        return sympy.Mul(sympy.S.NegativeOne if term.negative else sympy.S.One, *factors)

    def _fixed(self, node: ast.Expression, formals: Mapping[str, Expr] | None = None) -> Expr:
        """An expression with `let`s substituted, for places in which only constants and arguments may occur."""
        result = self._expression(node, formals)
        names = {s.name for s in result.free_symbols}
        if not any(self._table[n].kind is Kind.LET for n in names if n in self._table):
            return result
        if not self._fixed_lets:
            for name in self._checked.order:
                statement = self._table[name].statement
                if isinstance(statement, ast.LetStatement):
                    value = self._expression(statement.value)
                    self._fixed_lets[symbol(name)] = value.xreplace(self._fixed_lets)
        return result.xreplace(self._fixed_lets)

    # ------------------------------------------------------------------------------------------------------ statements

    def model(self) -> ir.Model:
        """The whole model."""
        head = next(self._checked.all(ast.ModelStatement), None)
        networks, functions = self._unknowns()
        model = ir.Model(
            name=head.name.text if head is not None else "model",
            title=string(head.title) if head is not None else "",
            time=time_of(self._checked),
            states=self._states(),
            conditions=tuple(self._condition(s) for s in self._checked.all(ast.ConditionStatement)),
            inputs=tuple(self._input(s) for s in self._checked.all(ast.InputStatement)),
            constants=tuple(self._constant(s) for s in self._checked.all(ast.ConstStatement)),
            learnables=self._learnables(),
            networks=networks,
            unknowns=functions,
            tables=tuple(self._tables.values()),
            intermediates=tuple(self._intermediate(name) for name in self._checked.order),
            processes=tuple(self._process(s) for s in self._checked.all(ast.ProcessStatement)),
            balances=self._balances(),
            channels=tuple(self._channel(s) for s in self._checked.all(ast.ObserveStatement)),
            doses=tuple(self._dose(s) for s in self._checked.all(ast.DoseStatement)),
            diffusions=self._diffusions(),
            claims=tuple(self._claim(s) for s in self._checked.all(ast.ConserveStatement)),
            truth_constants=tuple(
                ir.TruthConstant(s.target.text, self._checked.truths[s.target.text])
                for s in self._checked.all(ast.TruthStatement)
                if s.target.text in self._checked.truths
            ),
            truth_functions=tuple(
                self._truth(s)
                for s in self._checked.all(ast.TruthStatement)
                if self._table[s.target.text].kind is Kind.UNKNOWN
            ),
            text=tables.text_of(self._checked),
            allowed=self._checked.allowed,
        )
        model = algebraic.lowered(model, self._checked, self._expression)
        model = events.lowered(model, self._checked, self._expression, self._fixed, self._findings)
        model = populations.completed(infused(model, self._checked, self._findings), self._checked)
        model = self._delays.completed(model, self._checked, self._fixed)
        model = steady.lowered(model, self._checked, self._fixed, self._findings)
        refuse_together(model, self._findings)
        return self._with_short_forms(model) if self._checked.arrays and not self._findings.failed else model

    def _with_short_forms(self, model: ir.Model) -> ir.Model:
        """The model with the short forms of its arrays."""
        states = places_of([s.name for s in model.states])
        channels = places_of([c.name for c in model.channels])
        intermediates = places_of([i.name for i in model.intermediates])
        families = self._short.families(
            {"balances": states, "starts": states, "channels": channels, "intermediates": intermediates}
        )
        model = replace(model, arrays=self._short.arrays(states), families=families)
        refuse_elements(model, self._findings)
        return model

    def _number(self, node: ast.Expression | None) -> float | None:
        return self._checked.numbers.value(node)

    def _range(self, interval: ast.Interval | None) -> ir.Range | None:
        ends = self._checked.numbers.interval(interval)
        return None if ends is None else ir.Range(*ends)

    def _states(self) -> tuple[ir.State, ...]:
        starts = {target_name(s.target).text: s for s in self._checked.all(ast.InitialStatement)}
        return tuple(
            ir.State(
                s.declarator.name.text,
                self._range(s.range),
                self._number(s.start),
                self._initial(starts.get(s.declarator.name.text)),
                unit=unit_text(s.unit),
                description=string(s.description),
                span=s.declarator.name.span,
            )
            for s in self._checked.all(ast.StateStatement)
        )

    def _initial(self, statement: ast.InitialStatement | None) -> ir.Initial:
        if statement is None:
            return ir.Initial("measured")
        if statement.steady:
            return ir.Initial("steady", span=statement.span)
        if statement.value is None:
            return ir.Initial("learned", span=statement.span)
        return ir.Initial("expression", self._fixed(statement.value), statement.span)

    def _condition(self, s: ast.ConditionStatement) -> ir.Condition:
        return ir.Condition(
            s.name.text,
            self._range(s.range),
            self._number(s.default),
            s.column.value if s.column is not None else s.name.text,
            tuple(name.text for name in s.categories.names) if s.categories is not None else (),
            unit=unit_text(s.unit),
            description=string(s.description),
            span=s.name.span,
        )

    def _input(self, s: ast.InputStatement) -> ir.Input:
        return ir.Input(
            s.name.text,
            s.interpolation or "held",
            self._range(s.range),
            self._number(s.default),
            s.column.value if s.column is not None else s.name.text,
            unit=unit_text(s.unit),
            description=string(s.description),
            span=s.name.span,
        )

    def _constant(self, s: ast.ConstStatement) -> ir.Constant:
        return ir.Constant(
            s.name.text,
            self._checked.constants[s.name.text],
            unit=unit_text(s.unit),
            description=string(s.description),
            span=s.name.span,
        )

    def _learnables(self) -> tuple[ir.Learnable, ...]:
        """The constants that are learned, then the effects."""
        constants = (self._learnable(s) for s in self._checked.all(ast.LearnStatement))
        effects = (populations.effect(s, string(s.description)) for s in self._checked.all(ast.EffectStatement))
        return (*constants, *effects)

    def _learnable(self, s: ast.LearnStatement) -> ir.Learnable:
        low, high = self._checked.numbers.bounds(s) or (-math.inf, math.inf)
        start = self._checked.numbers.start(s)
        return ir.Learnable(
            s.name.text,
            start if start is not None and low <= start <= high else default_start(low, high),
            ir.Range(low, high),
            self._prior(s.prior),
            s.per is not None,
            populations.distribution(s, self._checked),
            any(grouping.column.value == SUBJECT for grouping in s.groupings),
            unit=unit_text(s.unit),
            description=string(s.description),
            span=s.name.span,
        )

    def _prior(self, prior: ast.Distribution | None) -> ir.Prior | None:
        if prior is None:
            return None
        location, scale = (self._number(a) or 0.0 for a in prior.arguments)
        return ir.Prior("lognormal" if prior.kind.text == "lognormal" else "normal", location, scale)

    def _intermediate(self, name: str) -> ir.Intermediate:
        statement = self._table[name].statement
        if isinstance(statement, ast.ProcessStatement):
            value, kind, unit = self._expression(statement.rate), "rate", None
        else:
            statement = cast(ast.LetStatement, statement)
            value, kind, unit = self._expression(statement.value), "let", unit_text(statement.unit)
        return ir.Intermediate(
            name,
            value,
            "rate" if kind == "rate" else "let",
            unit=unit,
            description=string(statement.description),
            span=statement.name.span,
        )

    def _process(self, s: ast.ProcessStatement) -> ir.Process:
        return ir.Process(
            s.name.text, self._coefficients(s.name.text), description=string(s.description), span=s.name.span
        )

    def _balances(self) -> tuple[Expr, ...]:
        given = {target_name(s.target).text: s for s in self._checked.all(ast.BalanceStatement)}
        names = [s.declarator.name.text for s in self._checked.all(ast.StateStatement)]
        return tuple(self._expression(given[n].value) if n in given else self._net(n) for n in names)

    def _channel(self, s: ast.ObserveStatement) -> ir.Channel:
        name = target_name(s.target).text
        value = symbol(name) if s.value is None else self._expression(s.value)
        noise = None
        if s.noise is not None:
            noise = self._noise(s.noise, name)
        return ir.Channel(
            name,
            value,
            self._position_of.get(value.name) if value.is_Symbol else None,
            noise,
            s.column.value if s.column is not None else name,
            unit=unit_text(s.unit),
            description=string(s.description),
            span=target_name(s.target).span,
        )

    def _noise(self, noise: ast.Distribution, name: str) -> Noise:
        """A noise: a number, or an expression that is learned."""
        kind = cast(NoiseKind, noise.kind.text)
        form = NOISES[kind]
        shape = self._fixed(noise.arguments[-1]) if form.shape else None
        if form.counts:
            return Noise(kind, math.nan, deviation_of_counts(shape), shape)
        argument = noise.arguments[0]
        value = self._fixed(argument, {PREDICTION: PREDICTED, name: PREDICTED})
        if form.density:
            return Noise(kind, math.nan, value, shape)
        learned = {s for s in value.free_symbols if s == PREDICTED or self._table[s.name].kind is Kind.LEARN}
        return Noise(kind, math.nan, value) if learned else Noise(kind, self._number(argument) or 0.0)

    def _dose(self, s: ast.DoseStatement) -> ir.Dose:
        fraction = self._fixed(s.fraction) if s.fraction is not None else sympy.S.One
        lag = self._fixed(s.lag) if s.lag is not None else sympy.S.Zero
        duration = self._fixed(s.duration) if s.duration is not None else None
        return ir.Dose(target_name(s.target).text, fraction, lag, duration, span=s.span)

    def _diffusions(self) -> tuple[ir.Diffusion, ...]:
        numbers = {symbol(name): value for name, value in self._checked.constants.items()}
        return tuple(
            disturbance(
                target_name(s.target).text,
                self._fixed(s.value),
                self._position_of,
                numbers,
                s.value.span,
                self._findings,
            )
            for s in self._checked.all(ast.DiffusionStatement)
        )

    def _claim(self, s: ast.ConserveStatement) -> ir.Claim:
        rate = self._expression(s.rate) if s.rate is not None else sympy.S.Zero
        return ir.Claim(
            s.name.text, self._expression(s.value), rate, description=string(s.description), span=s.name.span
        )

    # ------------------------------------------------------------------------------------------------------- unknowns

    def _unknowns(self) -> tuple[tuple[ir.Network, ...], tuple[ir.Unknown, ...]]:
        networks: list[ir.Network] = []
        functions: list[ir.Unknown] = []
        for s in self._checked.all(ast.UnknownStatement):
            nodes = s.postulates if len(s.postulates) == len(s.names) else s.postulates * len(s.names)
            bounds = [node for contract in s.contracts for node in contract_values(contract)]
            names, closed = self._closed([a.name.text for a in s.arguments], [*nodes, *bounds], {"nn": ir.NN})
            posts, renamed = closed[: len(nodes)], dict(zip((a.name.text for a in s.arguments), names, strict=True))
            agreed = lower_contracts(s, closed[len(nodes) :], renamed)
            arguments = tuple(
                ir.Argument(name, unit_text(a.unit), self._range(a.range))
                for name, a in zip(names, s.arguments, strict=True)
            )
            network = ir.Network(
                tuple(n.text for n in s.names),
                arguments,
                network_widths(s.network, self._checked.numbers),
                cast(ir.Activation, network_activation(s.network)),
                spline=spline_sizes(s.network, len(arguments), self._checked.numbers),
            )
            units = s.units if len(s.units) == len(s.names) else s.units * len(s.names)
            for output, name in enumerate(s.names):
                functions.append(
                    ir.Unknown(
                        name.text,
                        len(networks),
                        output,
                        posts[output] if posts else ir.NN,
                        neutral(nodes[output]) if nodes else 0.0,
                        agreed[name.text],
                        unit=unit_text(units[output]) if units else None,
                        description=string(s.description),
                        span=name.span,
                    )
                )
            networks.append(network)
        return tuple(networks), tuple(functions)

    def _truth(self, s: ast.TruthStatement) -> ir.TruthFunction:
        names, (value,) = self._closed(truth_parameters(s, self._table), [s.value], {})
        return ir.TruthFunction(s.target.text, names, value)

    def _closed(
        self, parameters: Sequence[str], nodes: Sequence[ast.Expression], given: Mapping[str, Expr]
    ) -> tuple[tuple[str, ...], list[Expr]]:
        """Expressions with parameters; a parameter that shadows a constant still used in them is renamed."""
        dummies = {name: sympy.Dummy(name, real=True) for name in parameters}
        values = [self._fixed(node, {**dummies, **given}) for node in nodes]
        taken = {s.name for value in values for s in value.free_symbols if not isinstance(s, sympy.Dummy)}
        names: list[str] = []
        for name in parameters:
            free = name
            while free in taken or (free != name and free in self._table):
                free += "_"
            taken.add(free)
            names.append(free)
        renamed = {dummies[old]: symbol(new) for old, new in zip(parameters, names, strict=True)}
        return tuple(names), [value.xreplace(renamed) for value in values]
