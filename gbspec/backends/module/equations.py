"""The equations of a model as methods of the generated class."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence

import sympy

from gbspec.backends.module.constrained import Constrained, document
from gbspec.backends.module.writing import comma, left_side, method_text
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
    identifier,
    is_vector,
    temporary,
)
from gbspec.diagnostics import Defect
from gbspec.ir import NN, Declared, Delay, Expr, Input, Model, Network, Switch, Unknown, Vector

PARAMETERS = ("math", "state", "condition", "inputs", "constants", "networks")


def scope(model: Model, *more: str) -> Names:
    """The identifiers in a method of the whole model: time, states, conditions, inputs and constants; `more` are other
    parameters."""
    names = Names((*PARAMETERS, *more))
    names.fix(STATE, "state")
    names.claim(model.time.symbol)
    for item in (*model.states, *model.conditions, *model.inputs, *model.constants, *model.learnables):
        names.claim(item.symbol)
    for variable in model.algebraics:
        names.claim(variable.symbol)
    for delay in model.delays:
        names.claim(delay.symbol, f"{delay.source}_delayed")
    for switch in model.switches:
        names.claim(switch.symbol)
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
        return method_text("@staticmethod", method_name(network), parameters, _described(posed), [f"return {call}"])
    raw, values = _postulated(posed)
    lines = _unpacked_constants(model, names, _strange_to(network, values, raw, model))
    lines += _corrected(model, posed, names, call, raw, values)
    return method_text("@staticmethod", method_name(network), parameters, _described(posed), lines)


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
    lines = [f"{left_side(names.claim(symbol) for symbol in raw)} = {call}"]
    lines += _statements(Program(model, bodies, ()).statements, names, model)
    return [*lines, f"return ({comma(names[body.symbol] for body in bodies)})"]


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
    lines.append(f"return ({comma(names[body.symbol] for body in bodies)})")
    described = ". ".join(part for part in (_described(posed), document(posed)) if part)
    return method_text("@staticmethod", method_name(network), parameters, described, lines)


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
    return method_text("@classmethod", name, ["cls", *parameters], document, body)


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
        return f"math.pack(state, ({comma(names[symbol] for symbol in results)}))"
    parts = [names[s] if is_vector(s) else f"math.column({names[s]})" for s in results]
    return parts[0] if len(parts) == 1 else f"math.join(state, {', '.join(parts)})"


def initial_method(model: Model) -> str:
    """`initial`: the initial values that the model gives, each after those that it depends on."""
    names = Names(PARAMETERS)
    names.fix(STATE, "state")
    for item in (*model.states, *model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    expressed = [s for s in model.states if s.initial.known and s.initial.value is not None]
    document = "The initial state: `state`, with the initial values that the model gives inserted."
    parameters = ["cls", "math", "state", "condition", "constants"]
    if not expressed:
        return method_text("@classmethod", "initial", parameters, document, ["return state"])
    if model.arrays:
        return method_text("@classmethod", "initial", parameters, document, _short_starts(model, names))
    outputs = [Assignment(s.symbol, s.initial.value, s.name) for s in expressed]
    program = Program(model, outputs).statements
    given = {s.symbol for s in model.states} - {s.symbol for s in expressed}
    body = _unpacked(model, names, _used(program), given=given)
    body += _statements(program, names, model)
    body.append(f"return math.pack(state, ({comma(names[s.symbol] for s in model.states)}))")
    return method_text("@classmethod", "initial", parameters, document, body)


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
        else:
            _append_given(results, run)
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
    body.append(f"return ({comma(pairs)})")
    document = "For each dose the fraction that arrives, and its lag."
    return method_text("@classmethod", "doses", ["cls", "math", "condition", "constants"], document, body)


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
    body.append(f"return math.pack(state, ({comma(names[output.symbol] for output in outputs)}))")
    parameters = ["cls", "math", "state", "condition", "inputs", "constants"]
    document = (
        "The size of each state's random disturbance; of its logarithm, where the size is proportional to the state; "
        "of its logit between two numbers, where it is proportional to the distances from both."
    )
    return [method_text("@classmethod", "diffusions", parameters, document, body)]


# ---------------------------------------------------------------------- parts of a method
def body_of(
    model: Model,
    outputs: Sequence[Assignment],
    names: Names,
    read: Iterable[sympy.Symbol] = (),
    solved: bool = True,
) -> list[str]:
    """Lines that unpack what is used, and compute the outputs; `read` is unpacked as well. `solved`: algebraic
    variables are solved for where they are used. With arrays, the states that outputs use are entries of the vector,
    and none are in `read`."""
    definitions = None
    if model.arrays:
        vectors = Vectors(model)
        definitions = [*vectors.definitions, *vectors.entries(outputs)]
    program = Program(model, outputs, definitions)
    used = _used(program.statements) | set(read)
    if not solved:
        used -= {item.symbol for item in model.algebraics}
    return _unpacked(model, names, used) + _statements(program.statements, names, model)


def kept(model: Model, replaced: Container[str]) -> set[sympy.Symbol]:
    """What `body_of` has to read for `state_with`: the states that are not replaced, by their names."""
    return set() if model.arrays else {state.symbol for state in model.states if state.name not in replaced}


def state_with(model: Model, values: Mapping[str, sympy.Symbol], names: Names) -> str:
    """The state with other values of some states, by their names; with arrays, what stays is parts of the vector."""
    if not model.arrays:
        return f"math.pack(state, ({comma(names[values.get(s.name, s.symbol)] for s in model.states)}))"
    if not values:
        return "state"
    results: list[Expr] = []
    for place, state in enumerate(model.states):
        if state.name in values:
            results.append(Column(values[state.name]))
        else:
            _append_given(results, place)
    printer = PythonPrinter(lambda symbol: names[symbol])
    return printer.print(results[0] if len(results) == 1 else Join(STATE, *results))


def _append_given(results: list[Expr], place: int) -> None:
    """Appends an entry of the given state; consecutive ones are one part."""
    if results and isinstance(results[-1], Part) and results[-1].args[2] == place:
        results[-1] = Part(STATE, results[-1].args[1], place + 1)
    else:
        results.append(Part(STATE, place, place + 1))


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
            lines.append(f"{left_side(targets)} = cls.{method}({arguments})")
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
    external: tuple[Input | Delay | Switch, ...] = (*model.inputs, *model.delays, *model.switches)
    vectors: list[tuple[str, Sequence[Declared | Delay | Switch]]] = [
        ("state", states),
        ("condition", model.conditions),
    ]
    for vector, items in (*vectors, ("inputs", external)):
        wanted = [item.symbol in (given if given is not None and vector == "state" else used) for item in items]
        if any(wanted):
            targets = [names[item.symbol] if want else "_" for item, want in zip(items, wanted, strict=True)]
            value = f"math.unpack({vector})"
            if vector == "inputs" and model.switches:  # without sides behind them nothing is held
                targets, value = [*targets, "*_"], f"(*{value}, {comma('0.0' for _ in model.switches)})"
            lines.append(f"{left_side(targets)} = {value}")
    variables = [names[item.symbol] if item.symbol in used else "_" for item in model.algebraics]
    if any(name != "_" for name in variables):
        call = f"cls.algebraic(math, {names[model.time.symbol]}, {', '.join(PARAMETERS[1:])})"
        lines.append(f"{left_side(variables)} = math.unpack({call})")
    return lines + _unpacked_constants(model, names, used)


def _unpacked_constants(model: Model, names: Names, used: set[Expr]) -> list[str]:
    items = (*model.constants, *model.learnables)
    if not any(item.symbol in used for item in items):
        return []
    return [f"{left_side(names.claim(i.symbol) if i.symbol in used else '_' for i in items)} = constants"]
