"""A Model as text: stable, complete, for reading and for golden files."""

from __future__ import annotations

from collections.abc import Iterable

from sympy.core.numbers import Float
from sympy.printing.precedence import precedence
from sympy.printing.str import StrPrinter

from gbspec.ir.algebra import EquationBlock
from gbspec.ir.arrays import Family, StateArray
from gbspec.ir.categories import category_text
from gbspec.ir.distributions import Distribution, Level, Noise
from gbspec.ir.events import Event, Timing
from gbspec.ir.model import NN, Condition, Contract, Declared, Dose, Expr, Model, Network, Range, Table, Unknown
from gbspec.ir.noises import NOISES


class _Printer(StrPrinter):  # type: ignore[misc] # sympy is untyped
    """Prints floats in full double precision: sympy's own printer cuts them to 15 digits."""

    def _print_Float(self, expr: Float) -> str:  # noqa: N802 - sympy finds it by this name
        return repr(float(expr))


class _LanguagePrinter(_Printer):
    """Prints what a `.gb` file would have: `if`, `max`, `min`, `abs`, `and`, `or`, `not`, and the names of categories
    with which `conditions` are compared."""

    def __init__(self, conditions: Iterable[Condition] = ()) -> None:
        super().__init__()
        self._categories = {c.symbol: c.categories for c in conditions if c.categories}

    def _print_Relational(self, expr: Expr) -> str:  # noqa: N802
        left, right = (self.parenthesize(part, precedence(expr)) for part in expr.args)
        if expr.rel_op not in ("==", "!="):
            return f"{left} {expr.rel_op} {right}"
        for symbol, number in (expr.args, expr.args[::-1]):
            if symbol in self._categories and number.is_number:
                left, right = str(symbol), category_text(self._categories[symbol][int(number)])
        return f"{left} == {right}" if expr.rel_op == "==" else f"not ({left} == {right})"

    def _print_Exp1(self, expr: Expr) -> str:  # noqa: N802
        return "exp(1)"

    def _print_Piecewise(self, expr: Expr) -> str:  # noqa: N802
        text = self._print(expr.args[-1][0])
        for value, condition in reversed(expr.args[:-1]):
            text = f"if({self._print(condition)}, {self._print(value)}, {text})"
        return str(text)

    def _print_Max(self, expr: Expr) -> str:  # noqa: N802
        return f"max({self.stringify(expr.args, ', ')})"

    def _print_Min(self, expr: Expr) -> str:  # noqa: N802
        return f"min({self.stringify(expr.args, ', ')})"

    def _print_Abs(self, expr: Expr) -> str:  # noqa: N802
        return f"abs({self._print(expr.args[0])})"

    def _print_And(self, expr: Expr) -> str:  # noqa: N802
        return " and ".join(f"({self._print(part)})" for part in expr.args)

    def _print_Or(self, expr: Expr) -> str:  # noqa: N802
        return " or ".join(f"({self._print(part)})" for part in expr.args)

    def _print_Not(self, expr: Expr) -> str:  # noqa: N802
        return f"not ({self._print(expr.args[0])})"


_PRINTER = _Printer()


def written(expression: Expr) -> str:
    """An expression as text, its floats in full precision."""
    return str(_PRINTER.doprint(expression))


def in_language(expression: Expr, conditions: Iterable[Condition] = ()) -> str:
    """An expression as a `.gb` file would have it, with the names of the categories of these conditions."""
    return str(_LanguagePrinter(conditions).doprint(expression)).replace("**", "^")


def contract_text(contract: Contract) -> str:
    """A contract in the syntax of a `.gb` file."""
    value = "" if contract.value is None else in_language(contract.value)
    match contract.kind:
        case "lower":
            return f">= {value}"
        case "upper":
            return f"<= {value}"
        case "zero":
            return f"zero at {contract.argument} = {value}"
        case "equals":
            reached = "" if contract.to is None else in_language(contract.to)
            return f"equals {reached} at {contract.argument} = {value}"
        case "period":
            return f"period {value} in {contract.argument}"
        case "increasing" | "decreasing" | "convex" | "concave" | "odd" | "even":
            return f"{contract.kind} in {contract.argument}"


def guarantee(unknown: Unknown) -> str:
    """The guarantees of an unknown for all weights, and for which arguments; empty if there are none."""
    if unknown.form is None or not unknown.contracts:
        return ""
    contracts = ", ".join(map(contract_text, unknown.contracts))
    within = ", ".join(unknown.form.within)
    scope = f"for {within} in range" if unknown.form.scope == "ranges" else "for all real arguments"
    return f"{contracts}; {scope}" + "".join(f"; {note}" for note in unknown.form.notes)


def dump(model: Model) -> str:
    """Every part of the Model, one per line, in its order; numbers in full precision. Ends with a line end."""
    lines = [f"model {model.name}" + _quoted(model.title), *_declarations(model), *_mathematics(model)]
    lines += _section(
        "truths",
        (
            *(f"{t.name} = {t.value!r}" for t in model.truth_constants),
            *(f"{t.name}({', '.join(t.parameters)}) = {written(t.value)}" for t in model.truth_functions),
        ),
    )
    lines += _section("allowed", (code + (f" {name}" if name else "") for code, name in model.allowed))
    return "\n".join(lines) + "\n"


def _declarations(model: Model) -> list[str]:
    """The lines of declarations: time, states, conditions, inputs, constants, networks."""
    lines: list[str] = []
    lines.append(
        f"time {model.time.name}{_unit(model.time)}"
        + ("" if model.time.start is None else f" from {model.time.start!r}")
    )
    lines += _section("states", (_state(model, i) for i in range(len(model.states))))
    lines += _section(
        "conditions",
        (f"{_head(c)}{_among(c)}{_default(c.default)}{_column(c.name, c.column)}" for c in model.conditions),
    )
    lines += _section(
        "inputs",
        (
            f"{_head(u)}{_range(u.range)} {u.interpolation}{_default(u.default)}{_column(u.name, u.column)}"
            for u in model.inputs
        ),
    )
    lines += _section(
        "algebraics",
        (f"{_head(a)}{_range(a.range)}{_default(a.start)}" for a in model.algebraics),
    )
    lines += _section("constants", (f"{_head(c)} = {c.value!r}" for c in model.constants))
    lines += _section(
        "learnables",
        (
            f"{_head(k)} = {k.start!r}{_range(k.range)}"
            + ("" if k.prior is None else f" prior {k.prior.kind}({k.prior.location!r}, {k.prior.scale!r})")
            + (" per trajectory" if k.per_trajectory else "")
            + ("" if k.distribution is None else _distribution(k.distribution))
            for k in model.learnables
        ),
    )
    lines += _section("implied", (f"{_head(k)} = {k.start!r}{_range(k.range)}" for k in model.implied))
    lines += _section("correlated", (", ".join(names) for names in model.correlated))
    lines += _section("tables", map(_table, model.tables))
    return lines + _section("networks", (_network(network) for network in model.networks))


def _mathematics(model: Model) -> list[str]:
    """The lines of expressions: postulates, intermediates, processes, balances, channels, doses, claims."""
    lines = _section(
        "unknowns",
        (
            f"{_head(u)} = {written(u.postulate)}"
            + ("" if u.postulate == NN else f"  (nn begins at {u.neutral!r})")
            + (f"  ({guarantee(u)}; as {written(u.form.value)})" if u.form is not None and u.contracts else "")
            for u in model.unknowns
        ),
    )
    lines += _section("intermediates", (f"{i.kind} {_head(i)} = {written(i.value)}" for i in model.intermediates))
    lines += _section(
        "processes",
        (
            f"{p.name}: " + ", ".join(f"{state} {written(coefficient)}" for state, coefficient in p.stoichiometry)
            for p in model.processes
        ),
    )
    lines += _section(
        "balances", (f"{s.name}' = {written(b)}" for s, b in zip(model.states, model.balances, strict=True))
    )
    lines += _section("equations", (f"{e.name}: {written(e.left)} = {written(e.right)}" for e in model.constraints))
    lines += _section("blocks", map(_block, model.blocks))
    lines += _section(
        "channels",
        (
            f"{_head(c)} = {written(c.value)}"
            + ("" if c.state is None else f"  (state {c.state})")
            + ("" if c.noise is None else f" noise {_noise(c.noise)}")
            + _column(c.name, c.column)
            for c in model.channels
        ),
    )
    lines += _section("doses", (_dose(d) for d in model.doses))
    lines += _section(
        "diffusions",
        (
            f"{d.state} by {written(d.value)}"
            + ("" if d.relative is None else f"  ({'logit' if d.between else 'logarithm'} by {written(d.relative)})")
            for d in model.diffusions
        ),
    )
    lines += _section("delays", (f"{d.name}: {d.source} by {written(d.lag)} >= {d.least!r}" for d in model.delays))
    lines += _section("events", map(_event, model.events))
    lines += _section("arrays", (line for array in model.arrays for line in _array(array)))
    lines += _section("families", map(_family, model.families))
    claims = (f"{_head(c)} = {written(c.value)} rate {written(c.rate)}" for c in model.claims)
    return lines + _section("claims", claims)


def _block(block: EquationBlock) -> str:
    how = " by a formula" if block.explicit else ""
    return f"{', '.join(block.equations)} for {', '.join(block.variables)}{how}"


def _distribution(found: Distribution) -> str:
    own = f" ~ {found.kind}({_spread(found)})" if found.spread is not None or found.fixed or not found.levels else ""
    return own + "".join(f" per {level.column} ~ {found.kind}({_spread(level)})" for level in found.levels)


def _spread(of: Distribution | Level) -> str:
    return of.spread if of.spread is not None else repr(of.fixed)


def _dose(dose: Dose) -> str:
    over = "" if dose.duration is None else f" over {written(dose.duration)} as {dose.infusion}"
    return f"{dose.state}{over} times {written(dose.fraction)} lag {written(dose.lag)}"


def _event(event: Event) -> str:
    if event.guard is not None:
        when = f"when {written(event.guard)} >= 0" + (" armed" if event.armed else "")
    else:
        timing = event.timing or Timing()
        parts = zip(("at", "every", "until"), (timing.at, timing.every, timing.until), strict=True)
        when = " ".join(f"{word} {written(value)}" for word, value in parts if value is not None)
    rank = repr(event.priority) if event.rank is None else written(event.rank)
    priority = f" priority {rank}" if event.priority or event.rank is not None else ""
    return f"{event.name} {when}{priority}: " + ", ".join(f"{name} = {written(v)}" for name, v in event.values)


def _noise(noise: Noise) -> str:
    scale = [] if NOISES[noise.kind].counts else [repr(noise.scale) if noise.value is None else written(noise.value)]
    parameters = scale if noise.shape is None else [*scale, written(noise.shape)]
    return f"{noise.kind}({', '.join(parameters)})" if parameters else noise.kind


def _array(array: StateArray) -> Iterable[str]:
    yield f"{array.name}[{array.first}..{array.last}] from state {array.position}"
    for index, value in array.ends:
        yield f"{array.name}[{index}] = {written(value)}"


def _family(family: Family) -> str:
    running = "" if family.index is None else f" for {family.index} from {family.first}"
    return f"{family.vector} {family.begin} to {family.begin + family.count - 1}: {written(family.value)}{running}"


def _section(title: str, entries: Iterable[str]) -> list[str]:
    body = [f"  {entry}" for entry in entries]
    return [title, *body] if body else []


def _quoted(text: str) -> str:
    return f' "{text}"' if text else ""


def _unit(item: Declared) -> str:
    return f" : {item.unit}" if item.unit else ""


def _head(item: Declared) -> str:
    return f"{item.name}{_unit(item)}"


def _range(bounds: Range | None) -> str:
    return "" if bounds is None or bounds == Range() else f" in [{bounds.low!r}, {bounds.high!r}]"


def _among(condition: Condition) -> str:
    """The range, or the categories."""
    if not condition.categories:
        return _range(condition.range)
    return " in {" + ", ".join(f'"{name}"' for name in condition.categories) + "}"


def _default(value: float | None) -> str:
    return "" if value is None else f" = {value!r}"


def _column(name: str, column: str) -> str:
    return f' as "{column}"' if column and column != name else ""


def _network(network: Network) -> str:
    arguments = ", ".join(f"{a.name}{f' : {a.unit}' if a.unit else ''}{_range(a.range)}" for a in network.arguments)
    sizes = "-".join(str(n) for n in network.sizes)
    kind = f"spline {'-'.join(map(str, network.spline))}" if network.spline else f"mlp {sizes} {network.activation}"
    return f"{', '.join(network.outputs)}({arguments}) by {kind}"


def _table(table: Table) -> str:
    """The digest stands for the points."""
    curve = table.curve
    units = table.units or (None,) * len(table.arguments)
    given = (
        f"{name}{f' : {unit}' if unit else ''} in [{places[0]!r}, {places[-1]!r}]"
        for name, unit, places in zip(table.arguments, units, curve.knots, strict=True)
    )
    count = len(curve.values)
    return (
        f"{table.name}({', '.join(given)}){_unit(table)}: {count} points, {curve.interpolation}, outside "
        f"{curve.outside}, {curve.digest}"
    )


def _state(model: Model, index: int) -> str:
    state = model.states[index]
    initial = state.initial.kind if state.initial.value is None else written(state.initial.value)
    kind = " discrete" if state.discrete else ""
    before = "" if state.history is None else f" history {written(state.history)}"
    return f"{_head(state)}{_range(state.range)}{_default(state.start)} initial {initial}{kind}{before}"
