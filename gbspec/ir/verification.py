"""Checks the invariants of every Model, after lowering and after each pass; a failure is a defect of gbspec."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import sympy
from sympy.core.function import AppliedUndef

from gbspec.diagnostics import Defect
from gbspec.ir.forms import Form, described
from gbspec.ir.model import NN, Expr, Model, Network, symbol
from gbspec.ir.tables import Lookup


def verify(model: Model) -> None:
    """Checks that symbols are declared, arities, orders and indices agree, and numbers are finite.

    Raises:
        Defect: naming the part of the Model that breaks a rule.
    """
    _names(model)
    _networks(model)
    _expressions(model)
    _families(model)
    _forms(model)
    _numbers(model)


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise Defect(f"the Model is malformed: {what}")


def _names(model: Model) -> None:
    names = [model.time.name, *model.constant_names]
    for group in (model.states, model.conditions, model.inputs, model.intermediates, model.algebraics):
        names.extend(item.name for item in group)
    names.extend(item.name for item in (*model.unknowns, *model.tables))
    twice = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
    _require(not twice, f"declared twice: {twice}")
    _require(len(model.balances) == len(model.states), "one balance for each state")
    channels = [channel.name for channel in model.channels]
    _require(len(set(channels)) == len(channels), "channels of the same name")
    rates = {item.name for item in model.intermediates if item.kind == "rate"}
    _require(rates == {process.name for process in model.processes}, "processes and rates differ")


def _networks(model: Model) -> None:
    outputs = [[u.name for u in model.unknowns if u.network == i] for i in range(len(model.networks))]
    for network, names in zip(model.networks, outputs, strict=True):
        _require(tuple(names) == network.outputs, f"outputs of the network `{network.name}`")
        _require(bool(network.arguments), f"the network `{network.name}` has no argument")
        _require(all(width > 0 for width in network.hidden), f"widths of the network `{network.name}`")
    for unknown in model.unknowns:
        inside = 0 <= unknown.network < len(model.networks)
        _require(inside and model.networks[unknown.network].outputs[unknown.output] == unknown.name, unknown.name)


def _expressions(model: Model) -> None:
    constants = {symbol(name) for name in model.constant_names}
    conditions = {item.symbol for item in model.conditions}
    states = {item.symbol for item in model.states}
    known = constants | conditions | states | {item.symbol for item in model.inputs} | {model.time.symbol}
    known |= {item.symbol for item in model.algebraics}
    known |= {delay.symbol for delay in model.delays}
    tables = {table.name: table.curve for table in model.tables}
    arity = {u.name: len(model.networks[u.network].arguments) for u in model.unknowns}

    def check(what: str, expression: Expr, allowed: Iterable[sympy.Symbol], *, applies: bool = True) -> None:
        undeclared = sorted(str(s) for s in expression.free_symbols - set(allowed))
        _require(not undeclared, f"{what} uses {undeclared}")
        for application in expression.atoms(AppliedUndef):
            name = application.func.__name__
            _require(applies and arity.get(name) == len(application.args), f"{what} applies {name}")
        looked_up = {(type(a).table, type(a).curve) for a in expression.atoms(Lookup)}
        _require(looked_up <= tables.items(), f"{what} uses tables that the model does not have")
        _require(not expression.has(sympy.nan, sympy.zoo, sympy.oo, sympy.I), f"{what} is not finite")

    _intermediates(model, check, known)
    for state, balance in zip(model.states, model.balances, strict=True):
        check(f"the balance of `{state.name}`", balance, known)
        if state.initial.value is not None:
            check(f"the start of `{state.name}`", state.initial.value, constants | conditions | states, applies=False)
    for channel in model.channels:
        check(f"the channel `{channel.name}`", channel.value, known)
        is_state = channel.state is not None and channel.value == model.states[channel.state].symbol
        _require(channel.state is None or is_state, f"the state of the channel `{channel.name}`")
    for process in model.processes:
        for name, coefficient in process.stoichiometry:
            _require(name in model.state_index, f"`{process.name}` converts `{name}`")
            check(f"a coefficient of `{process.name}`", coefficient, constants, applies=False)
    for unknown in model.unknowns:
        formals = {argument.symbol for argument in model.networks[unknown.network].arguments}
        check(f"the postulate of `{unknown.name}`", unknown.postulate, constants | formals | {NN}, applies=False)
    for truth in model.truth_functions:
        formals = {symbol(name) for name in truth.parameters}
        _require(arity.get(truth.name) == len(truth.parameters), f"the truth of `{truth.name}`")
        check(f"the truth of `{truth.name}`", truth.value, constants | formals, applies=False)
    for claim in model.claims:
        check(f"the claim `{claim.name}`", claim.value, known)
        check(f"the rate of the claim `{claim.name}`", claim.rate, known)
    for dose in model.doses:
        _require(dose.state in model.state_index, f"a dose into `{dose.state}`")
        for part in (dose.fraction, dose.lag, *(() if dose.duration is None else (dose.duration,))):
            check(f"the dose into `{dose.state}`", part, constants | conditions, applies=False)
    given = constants | conditions | {item.symbol for item in model.inputs}
    for diffusion in model.diffusions:
        _require(diffusion.state in model.state_index, f"a diffusion of `{diffusion.state}`")
        what = f"the diffusion of `{diffusion.state}`"
        check(what, diffusion.value, given | {symbol(diffusion.state)}, applies=False)
        if diffusion.relative is not None:
            check(what, diffusion.relative, given, applies=False)
    _delays(model, check, known, constants | conditions)
    _events(model, check, known, constants | conditions)
    disturbed = [diffusion.state for diffusion in model.diffusions]
    _require(len(set(disturbed)) == len(disturbed), "two diffusions of a state")


def _intermediates(model: Model, check: Callable[..., None], known: set[sympy.Symbol]) -> None:
    """Checks intermediates, each of which may hold earlier ones and is `known` from then on, and equations."""
    for item in model.intermediates:
        check(f"`{item.name}`", item.value, known)
        known.add(item.symbol)
    for equation in model.constraints:
        check(f"the equation `{equation.name}`", equation.left, known)
        check(f"the equation `{equation.name}`", equation.right, known)


def _delays(model: Model, check: Callable[..., None], known: set[sympy.Symbol], fixed: set[sympy.Symbol]) -> None:
    """Checks what is delayed and by what, and what states were before the start."""
    for delay in model.delays:
        _require(delay.value in known, f"`{delay.name}` delays something else")
        check(f"`{delay.name}`", delay.lag, fixed, applies=False)
    for state in model.states:
        if state.history is not None:
            check(f"the history of `{state.name}`", state.history, fixed | {model.time.symbol}, applies=False)


def _events(model: Model, check: Callable[..., None], known: set[sympy.Symbol], fixed: set[sympy.Symbol]) -> None:
    """Checks that events set states, and what their conditions, times and values use."""
    for event in model.events:
        what = f"the event `{event.name}`"
        _require((event.guard is None) != (event.timing is None), f"when {what} happens")
        for value in (event.guard, event.rank):
            if value is not None:
                check(what, value, known)
        if event.timing is not None:
            for part in (event.timing.at, event.timing.every, event.timing.until):
                if part is not None:
                    check(what, part, fixed, applies=False)
        for name, value in event.values:
            _require(name in model.state_index, f"{what} sets `{name}`")
            check(what, value, known)


def _families(model: Model) -> None:
    """Checks that arrays and families lie within their vectors, do not overlap, and use only declared names."""
    arrays = {array.symbol: array for array in model.arrays}
    for array in model.arrays:
        names = [state.name for state in model.states[array.position : array.position + array.count]]
        _require(tuple(names) == array.names, f"the array `{array.name}`")
    known = {symbol(n) for n in (model.time.name, *model.constant_names)} | set(arrays)
    for group in (model.states, model.conditions, model.inputs, model.intermediates, model.algebraics):
        known |= {item.symbol for item in group}
    values = [(f"a family of {f.vector}", f.value, {f.index}) for f in model.families]
    values += [(f"an end of `{a.name}`", value, set()) for a in model.arrays for _, value in a.ends]
    for what, value, more in values:
        undeclared = sorted(map(str, value.free_symbols - known - more))
        _require(not undeclared, f"{what} uses {undeclared}")
        applied = {a.func.__name__ for a in value.atoms(AppliedUndef)}
        _require(applied <= model.unknown_names, f"{what} applies {sorted(applied - model.unknown_names)}")
    for vector in {family.vector for family in model.families}:
        places = [k for f in model.families if f.vector == vector for k in range(f.begin, f.begin + f.count)]
        covered = sum(1 if isinstance(run, int) else run.count for run in model.runs(vector))
        size = len({"channels": model.channels, "intermediates": model.intermediates}.get(vector, model.states))
        _require(len(set(places)) == len(places) and covered == size, f"families of {vector} overlap")


def _forms(model: Model) -> None:
    """Checks that a layout covers its network, and that a form uses only outputs of its evaluations of the network."""
    for network in model.networks:
        if network.layout is not None:
            widths = tuple(sum(block.count for block in layer) for layer in network.layout.hidden)
            _require(widths == network.hidden, f"the layout of the network `{network.name}`")
            outputs = len(network.outputs) + network.layout.gates
            _require(len(network.layout.outputs) == outputs, f"the outputs of the layout of `{network.name}`")
    constants = {symbol(name) for name in model.constant_names}
    for unknown in model.unknowns:
        if unknown.form is None:
            continue
        network = model.networks[unknown.network]
        known = constants | {argument.symbol for argument in network.arguments}
        sizes = {len(evaluation) for evaluation in unknown.form.evaluations}
        _require(sizes <= {len(network.arguments)}, f"the evaluations of the form of `{unknown.name}`")
        for part in (unknown.form.value, *(p for evaluation in unknown.form.evaluations for p in evaluation)):
            used = [(s, described(s.name)) for s in part.free_symbols - known]
            wrong = sorted(str(s) for s, meant in used if meant is None or not _inside(meant, unknown.form, network))
            _require(not wrong, f"the form of `{unknown.name}` uses {wrong}")


def _inside(meant: tuple[str, tuple[int, ...]], form: Form, network: Network) -> bool:
    """Whether the indices in a symbol of a form exist: an evaluation, an output (gates included), an argument."""
    outputs = len(network.outputs) + (0 if network.layout is None else network.layout.gates)
    match meant:
        case "raw", (evaluation, output):
            return evaluation < len(form.evaluations) and output < outputs
        case "center" | "scale", (output,):
            return output < outputs
        case "input_scale", (argument,):
            return argument < len(network.arguments)
        case _:
            return False


def _numbers(model: Model) -> None:
    for constant in model.constants:
        _require(math.isfinite(constant.value), f"the value of `{constant.name}`")
    for learnable in model.learnables:
        bounds = learnable.range
        _require(bounds.low <= learnable.start <= bounds.high, f"the start of `{learnable.name}`")
    ranges = [(item.name, item.range) for item in model.states]
    ranges += [(item.name, item.range) for item in model.conditions]
    ranges += [(item.name, item.range) for item in model.inputs]
    for name, bounds_of in ranges:
        _require(bounds_of is None or bounds_of.low < bounds_of.high, f"the range of `{name}`")
