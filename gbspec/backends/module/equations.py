"""The equations of a model as methods of the generated class."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import assert_never

import sympy

from gbspec.backends.module.constrained import Constrained, document
from gbspec.backends.printing import (
    STATE,
    Assignment,
    Column,
    Entry,
    Join,
    Names,
    NetworkCall,
    Part,
    Program,
    PythonPrinter,
    Statement,
    Vectors,
    VectorTemporary,
    docstring,
    identifier,
    is_vector,
    temporary,
)
from gbspec.diagnostics import Defect
from gbspec.ir import NN, Explicit, Expr, Method, Model, Network, RosenbrockW, Unknown, Vector

WIDTH = 120 - 8
"""The length of a line of a method, whose class stands in the model's."""
SIMPLE = 10**6
"""Fractions with larger denominators are written as decimal numbers."""
PARAMETERS = ("math", "state", "condition", "inputs", "constants", "networks")


def scope(model: Model) -> Names:
    """The identifiers in a method of the whole model: time, states, conditions, inputs and constants."""
    names = Names(PARAMETERS)
    names.fix(STATE, "state")
    names.claim(model.time.symbol)
    for item in (*model.states, *model.conditions, *model.inputs, *model.constants, *model.learnables):
        names.claim(item.symbol)
    return names


def method_name(network: Network) -> str:
    """The method that evaluates a network's unknowns."""
    return f"unknown_{identifier(network.name)}"


def unknown_method(model: Model, index: int) -> str:
    """The method of a network: its unknowns, with postulates applied, as functions of the formal arguments."""
    network = model.networks[index]
    names = Names(("math", "constants", "networks"))
    formals = [names.claim(argument.symbol) for argument in network.arguments]
    table = {unknown.name: unknown for unknown in model.unknowns}
    posed = [table[output] for output in network.outputs]
    call = f"networks[{index}]({', '.join(formals)})"
    parameters = ["math", "constants", "networks", *formals]
    if any(unknown.form is not None for unknown in posed):
        return _constrained_method(model, index, posed, names, parameters, call)
    if all(unknown.postulate == NN for unknown in posed):
        return _method("@staticmethod", method_name(network), parameters, _described(posed), [f"return {call}"])
    raw, values = _postulated(posed)
    lines = _unpacked_constants(model, names, _strange_to(network, values, raw, model))
    lines += _corrected(model, posed, names, call, raw, values)
    return _method("@staticmethod", method_name(network), parameters, _described(posed), lines)


def _postulated(posed: Sequence[Unknown]) -> tuple[list[sympy.Symbol], list[Expr]]:
    """A symbol for each correction, and the postulates in terms of these."""
    raw = [temporary(f"nn_{unknown.name}") for unknown in posed]
    return raw, [u.postulate.xreplace({NN: symbol}) for u, symbol in zip(posed, raw, strict=True)]


def _strange_to(network: Network, values: Iterable[Expr], raw: Iterable[Expr], model: Model) -> set[Expr]:
    """The constants in expressions, besides arguments and corrections. Raises `Defect` for other names."""
    used = {symbol for value in values for symbol in value.free_symbols}
    used -= {*raw, *(argument.symbol for argument in network.arguments)}
    unknown = used - {item.symbol for item in (*model.constants, *model.learnables)}
    if unknown:
        raise Defect(f"the postulate of `{network.name}` uses {sorted(map(str, unknown))}, not arguments or constants")
    return used


def _corrected(
    model: Model, posed: Sequence[Unknown], names: Names, call: str, raw: Sequence[sympy.Symbol], values: Sequence[Expr]
) -> list[str]:
    """Lines that call a network and evaluate the postulates with its outputs."""
    bodies = [Assignment(temporary(u.name), value, u.name) for u, value in zip(posed, values, strict=True)]
    lines = [f"{_targets(names.claim(symbol) for symbol in raw)} = {call}"]
    lines += _statements(Program(model, bodies, ()).statements, names, model)
    return [*lines, f"return ({_comma(names[body.symbol] for body in bodies)})"]


def _constrained_method(
    model: Model, index: int, posed: Sequence[Unknown], names: Names, parameters: Sequence[str], call: str
) -> str:
    """The method of a network with contracts: by its forms, or only by the postulates if numbers replace it."""
    network = model.networks[index]
    writer = Constrained(network, posed, names)
    raw, postulates = _postulated(posed)
    values = writer.values()
    used = _strange_to(network, [*values, *writer.expressions], writer.temporaries, model)
    used |= _strange_to(network, postulates, raw, model)
    lines = _unpacked_constants(model, names, used)
    plain = _corrected(model, posed, names.copy(), call, raw, postulates)
    lines += writer.calls_of(index, plain)
    bodies = [Assignment(temporary(u.name), value, u.name) for u, value in zip(posed, values, strict=True)]
    lines += _statements(Program(model, bodies, ()).statements, names, model)
    lines.append(f"return ({_comma(names[body.symbol] for body in bodies)})")
    described = ". ".join(part for part in (_described(posed), document(posed)) if part)
    return _method("@staticmethod", method_name(network), parameters, described, lines)


def _described(unknowns: Sequence[Unknown]) -> str:
    """The descriptions of the outputs, for the method's docstring."""
    described = (f"{unknown.name}: {unknown.description}" for unknown in unknowns if unknown.description)
    return " ".join("; ".join(described).split())


def rhs_method(model: Model) -> str:
    """`rhs`."""
    entries = [
        Assignment(temporary(f"d{state.name}"), balance, f"d{state.name}")
        for state, balance in zip(model.states, model.balances, strict=True)
    ]
    return _whole(model, "rhs", "balances", entries, "The time derivative of each state.")


def observe_method(model: Model) -> str:
    """`observe`."""
    entries = [Assignment(temporary(c.name), c.value, c.name) for c in model.channels]
    return _whole(model, "observe", "channels", entries, "The value of each channel.")


def _whole(model: Model, name: str, vector: Vector, entries: Sequence[Assignment], document: str) -> str:
    """A method of the whole state: unpack the used quantities, compute, pack the `entries` of the result's vector."""
    names = scope(model)
    outputs, definitions = _short(model, vector, entries)
    program = Program(model, outputs, definitions).statements
    bare = {output.symbol: output.value for output in outputs if output.value.is_Symbol and name != "rhs"}
    program = [s for s in program if not (isinstance(s, Assignment) and s.symbol in bare)]
    read = _used(program) | set(bare.values())
    body = _unpacked(model, names, read)
    body += _statements(program, names, model)
    body.append(f"return {_packed([bare.get(output.symbol, output.symbol) for output in outputs], names)}")
    parameters = ["math", names[model.time.symbol], "state", "condition", "inputs", "constants", "networks"]
    return _method("@classmethod", name, ["cls", *parameters], document, body)


def _short(
    model: Model, vector: Vector, entries: Sequence[Assignment]
) -> tuple[Sequence[Assignment], Sequence[Assignment] | None]:
    """The assignments for a vector, one for each family of its entries, and the definitions that they need."""
    if not model.arrays:
        return entries, None
    vectors = Vectors(model)
    outputs = []
    for run in model.runs(vector):
        entry = entries[run if isinstance(run, int) else run.begin]
        if not isinstance(run, int):
            wish = run.array if vector == "channels" else f"d{run.array}"
            many = run.index is not None
            symbol, wish = (VectorTemporary(wish, real=True), wish) if many else (entry.symbol, entry.wish)
            entry = Assignment(symbol, vectors.value(run), wish)
        outputs.append(entry)
    return outputs, [*vectors.definitions, *vectors.entries(outputs)]


def _packed(results: Sequence[Expr], names: Names) -> str:
    """The result's vector: scalars packed, or vectors joined."""
    if not any(is_vector(symbol) for symbol in results):
        return f"math.pack(state, ({_comma(names[symbol] for symbol in results)}))"
    parts = [names[s] if is_vector(s) else f"math.column({names[s]})" for s in results]
    return parts[0] if len(parts) == 1 else f"math.join(state, {', '.join(parts)})"


def initial_method(model: Model) -> str:
    """`initial`: the initial values that the model gives, each after those that it depends on."""
    names = Names(PARAMETERS)
    names.fix(STATE, "state")
    for item in (*model.states, *model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    expressed = [s for s in model.states if s.initial.kind == "expression" and s.initial.value is not None]
    document = "The initial state: `state`, with the initial values that the model gives inserted."
    parameters = ["cls", "math", "state", "condition", "constants"]
    if not expressed:
        return _method("@classmethod", "initial", parameters, document, ["return state"])
    if model.arrays:
        return _method("@classmethod", "initial", parameters, document, _short_starts(model, names))
    outputs = [Assignment(s.symbol, s.initial.value, s.name) for s in expressed]
    program = Program(model, outputs).statements
    given = {s.symbol for s in model.states} - {s.symbol for s in expressed}
    body = _unpacked(model, names, _used(program), given=given)
    body += _statements(program, names, model)
    body.append(f"return math.pack(state, ({_comma(names[s.symbol] for s in model.states)}))")
    return _method("@classmethod", "initial", parameters, document, body)


def _short_starts(model: Model, names: Names) -> list[str]:
    """The body of `initial` for a model with arrays; consecutive other states are parts of the given `state`."""
    vectors = Vectors(model)
    outputs: list[Assignment] = []
    of_families: list[Assignment] = []
    results: list[Expr] = []
    for run in model.runs("starts"):
        state = model.states[run if isinstance(run, int) else run.begin]
        if not isinstance(run, int):
            whole = VectorTemporary(run.array, real=True)
            outputs.append(Assignment(whole, vectors.value(run), run.array))
            members = model.states[run.begin : run.begin + run.count]
            of_families += [Assignment(s.symbol, Entry(whole, k), s.name) for k, s in enumerate(members)]
            results.append(whole)
        elif state.initial.value is not None:
            outputs.append(Assignment(state.symbol, state.initial.value, state.name))
            results.append(Column(state.symbol))
        elif results and isinstance(results[-1], Part) and results[-1].args[2] == run:
            results[-1] = Part(STATE, results[-1].args[1], run + 1)
        else:
            results.append(Part(STATE, run, run + 1))
    definitions = [*vectors.definitions, *of_families, *vectors.entries(outputs, [*outputs, *of_families])]
    program = Program(model, outputs, definitions).statements
    lines = _unpacked(model, names, _used(program)) + _statements(program, names, model)
    printer = PythonPrinter(lambda symbol: names[symbol])
    return [*lines, f"return {printer.print(results[0] if len(results) == 1 else Join(STATE, *results))}"]


def doses_method(model: Model) -> str:
    """`doses`: the fraction of each dose that arrives, and its lag; only in models with doses."""
    names = Names(PARAMETERS)
    for item in (*model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    outputs = []
    for i, dose in enumerate(model.doses):
        outputs.append(Assignment(temporary(f"fraction{i}"), dose.fraction, f"{dose.state}_fraction"))
        outputs.append(Assignment(temporary(f"lag{i}"), dose.lag, f"{dose.state}_lag"))
    program = Program(model, outputs, ()).statements
    body = _unpacked(model, names, _used(program)) + _statements(program, names, model)
    found = [names[output.symbol] for output in outputs]
    pairs = [f"({fraction}, {lag})" for fraction, lag in zip(found[::2], found[1::2], strict=True)]
    body.append(f"return ({_comma(pairs)})")
    document = "For each dose the fraction that arrives, and its lag."
    return _method("@classmethod", "doses", ["cls", "math", "condition", "constants"], document, body)


def diffusions_method(model: Model) -> list[str]:
    """`diffusions`: the sizes of random disturbances, in models that have any."""
    if not model.diffusions:
        return []
    names = scope(model)
    given = {d.state: d.value if d.relative is None else d.relative for d in model.diffusions}
    outputs = [
        Assignment(temporary(f"sigma{i}"), given.get(s.name, sympy.S.Zero), f"sigma_{s.name}")
        for i, s in enumerate(model.states)
    ]
    program = Program(model, outputs, ()).statements
    body = _unpacked(model, names, _used(program)) + _statements(program, names, model)
    body.append(f"return math.pack(state, ({_comma(names[output.symbol] for output in outputs)}))")
    parameters = ["cls", "math", "state", "condition", "inputs", "constants"]
    document = (
        "The size of each state's random disturbance; of its logarithm, where the size is proportional to the state."
    )
    return [_method("@classmethod", "diffusions", parameters, document, body)]


def solver_methods(method: Method) -> list[str]:
    """`grid` and `step`: one step of an integration method."""
    match method:
        case Explicit():
            return [
                _grid_method(method, [_multiple(factor, "column") for factor in _sizes(method)]),
                _step_method(method),
            ]
        case RosenbrockW():
            return [_grid_method(method, ["column"]), _rosenbrock_method(method)]
        case _:
            assert_never(method)


def _grid_method(method: Method, sizes: Sequence[str]) -> str:
    """`grid`: times and sizes within a step, for `step`."""
    times = ", ".join(map(step_time, method.nodes))
    body = ["column = math.column(h)  # to multiply vectors", f"return ({times}), ({_comma(sizes)})"]
    document = (
        f"The nodes of a step of size h from t ({method.name.upper()}): times of its inputs, and fractions of its size."
    )
    return _method("@staticmethod", "grid", ["math", "t", "h"], document, body)


def _step_method(method: Explicit) -> str:
    """`step`: one step of an explicit Runge-Kutta method."""
    nodes = method.nodes
    sizes = _targets(_size_name(factor) for factor in _sizes(method))
    body = [
        f"({_targets(f't{i}' for i in range(len(nodes)))}), ({sizes}) = grid",
        f"{_targets(f'u{i}' for i in range(len(nodes)))} = inputs",
    ]
    for i, (row, c) in enumerate(zip(method.a[: method.advancing], method.c, strict=False)):
        node = nodes.index(c)
        body.append(f"k{i + 1} = rhs(t{node}, {_ahead(row)}, u{node})")
    body.append(f"return {_ahead(method.b)}")
    times = ", ".join(map(step_time, nodes))
    document = f"One step ({method.name.upper()}) of state' = rhs(time, state, inputs); `inputs` are those at {times}."
    return _method("@staticmethod", "step", ["math", "rhs", "grid", "state", "inputs"], document, body)


def _rosenbrock_method(method: RosenbrockW) -> str:
    """`step`: one step of a Rosenbrock-W method."""
    nodes = method.nodes
    body = [
        f"({_targets(f't{i}' for i in range(len(nodes)))}), (h,) = grid",
        f"{_targets(f'u{i}' for i in range(len(nodes)))} = inputs",
        f"solve = solve or math.factored(rhs, t0, state, u0, {float(method.gamma)!r} * h)",
    ]
    for i, (row, coupling, c) in enumerate(zip(method.a, method.coupling, method.c, strict=True)):
        at = f"math.ahead(state, h, {_weighted(row)})" if any(row) else "state"
        rate = f"rhs(t{nodes.index(c)}, {at}, u{nodes.index(c)})"
        if any(coupling):
            body.append(f"v{i + 1} = {_weighted(coupling)}")
        body.append(f"k{i + 1} = solve({rate} + v{i + 1}) - v{i + 1}" if any(coupling) else f"k{i + 1} = solve({rate})")
    body.append(f"return math.ahead(state, h, {_weighted(method.b)})")
    times = ", ".join(map(step_time, nodes))
    document = (
        f"One step ({method.name.upper()}) of state' = rhs(time, state, inputs); `inputs` are those at {times}.\n\n"
        "`solve` divides by I - gamma h W; without it W is the Jacobian at the step's start."
    )
    return _method("@staticmethod", "step", ["math", "rhs", "grid", "state", "inputs", "solve=None"], document, body)


def _weighted(row: Sequence[Fraction]) -> str:
    """A weighted sum of Runge-Kutta stages, with decimal weights."""
    terms = (f"{float(b)!r} * k{i + 1}" if b != 1 else f"k{i + 1}" for i, b in enumerate(row) if b)
    return " + ".join(terms).replace("+ -", "- ")


def _sizes(method: Explicit) -> list[Fraction]:
    """The fractions of a step by which sums of Runge-Kutta stages are multiplied."""
    return sorted({_unit(row) for row in (*method.a[: method.advancing], method.b) if any(row)})


def _unit(row: Sequence[Fraction]) -> Fraction:
    """The smallest positive weight; one exists, since no node is before the step."""
    return min(weight for weight in row if weight > 0)


def _size_name(factor: Fraction) -> str:
    """`h`, `h_2` for h/2, `h2_3` for 2*h/3."""
    above = "h" if factor.numerator == 1 else f"h{factor.numerator}"
    return above if factor.denominator == 1 else f"{above}_{factor.denominator}"


def _ahead(row: Sequence[Fraction]) -> str:
    """The state plus the weighted sum of Runge-Kutta stages; stages with equal weights are added first."""
    if not any(row):
        return "state"
    unit = _unit(row)
    ratios = sorted({b / unit for b in row if b}, key=lambda ratio: (ratio != 1, ratio))
    sums = [" + ".join(f"k{i + 1}" for i, b in enumerate(row) if b == ratio * unit) for ratio in ratios]
    total = sums[0]
    for ratio, stages in zip(ratios[1:], sums[1:], strict=True):
        total = f"math.ahead({total}, {ratio}, {stages})"
    return f"math.ahead(state, {_size_name(unit)}, {total})"


def step_time(c: Fraction) -> str:
    """The time at a fraction of a step: `t`, `t + h/2`."""
    return "t" if c == 0 else f"t + {_multiple(c, 'h')}"


def _multiple(factor: Fraction, name: str) -> str:
    """`h/2`, `2*h`, `h`; `0.87*h` for a factor that is not simple."""
    if factor.denominator > SIMPLE:
        return f"{float(factor)!r}*{name}"
    above = name if factor.numerator == 1 else f"{factor.numerator}*{name}"
    return above if factor.denominator == 1 else f"{above}/{factor.denominator}"


# ---------------------------------------------------------------------- parts of a method
def _statements(program: Iterable[Statement], names: Names, model: Model) -> list[str]:
    printer = PythonPrinter(lambda symbol: names[symbol])
    lines = []
    for statement in program:
        if isinstance(statement, NetworkCall):
            constants = "math.columns(constants)" if any(map(is_vector, statement.arguments)) else "constants"
            given = [printer.print(argument) for argument in statement.arguments]
            if not any(argument.free_symbols for argument in statement.arguments):  # one point for the whole batch
                given = [f"math.fill(state, {number})" for number in given]
            arguments = ", ".join(["math", constants, "networks", *given])
            targets = [
                "_" if symbol is None else names.claim(symbol, wish)
                for symbol, wish in zip(statement.results, statement.wishes, strict=True)
            ]
            method = method_name(model.networks[statement.network])
            lines.append(f"{_targets(targets)} = cls.{method}({arguments})")
        else:
            text = printer.print(statement.value)
            lines.append(f"{names.claim(statement.symbol, statement.wish)} = {text}")
    return lines


def _used(program: Iterable[Statement]) -> set[sympy.Symbol]:
    used: set[sympy.Symbol] = set()
    for statement in program:
        values: Iterable[sympy.Basic] = [statement.value] if isinstance(statement, Assignment) else statement.arguments
        used |= {symbol for value in values for symbol in value.free_symbols}
    return used


def _unpacked(model: Model, names: Names, used: set[Expr], given: set[sympy.Symbol] | None = None) -> list[str]:
    """Lines that unpack the used quantities."""
    lines = []
    states = () if model.arrays else model.states  # with arrays, states are entries of the vector, and so statements
    for vector, items in (("state", states), ("condition", model.conditions), ("inputs", model.inputs)):
        wanted = [item.symbol in (given if given is not None and vector == "state" else used) for item in items]
        if any(wanted):
            targets = [names[item.symbol] if want else "_" for item, want in zip(items, wanted, strict=True)]
            lines.append(f"{_targets(targets)} = math.unpack({vector})")
    return lines + _unpacked_constants(model, names, used)


def _unpacked_constants(model: Model, names: Names, used: set[Expr]) -> list[str]:
    items = (*model.constants, *model.learnables)
    if not any(item.symbol in used for item in items):
        return []
    return [f"{_targets(names.claim(i.symbol) if i.symbol in used else '_' for i in items)} = constants"]


def _targets(names: Iterable[str]) -> str:
    """The left side of a tuple assignment."""
    listed = list(names)
    return f"({listed[0]},)" if len(listed) == 1 else ", ".join(listed)


def _comma(names: Iterable[str]) -> str:
    """The entries of a tuple."""
    listed = list(names)
    return f"{listed[0]}," if len(listed) == 1 else ", ".join(listed)


def _method(decorator: str, name: str, parameters: Sequence[str], document: str, body: Iterable[str]) -> str:
    typed = [
        parameter
        if parameter == "cls"
        else ": Any = ".join(parameter.split("="))
        if "=" in parameter
        else f"{parameter}: Any"
        for parameter in parameters
    ]
    head = f"def {name}({', '.join(typed)}) -> Any:"
    if len(head) > WIDTH:
        head = f"def {name}(\n    {', '.join(typed)}\n) -> Any:"
    lines = [decorator, head]
    if document:
        lines.append(f"    {docstring(document)}")
    return "\n".join([*lines, *(f"    {line}" for line in body)])
