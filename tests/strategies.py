"""Random Models for property tests: every construct that a backend can meet, values kept where nothing is singular."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from hypothesis import strategies as st
from numpy.typing import NDArray

from gbspec.ir.forms import logistic, softplus
from gbspec.ir.model import (
    NN,
    Argument,
    Channel,
    Condition,
    Constant,
    Dose,
    Initial,
    Input,
    Intermediate,
    Learnable,
    Model,
    Network,
    Range,
    State,
    Table,
    Unknown,
    symbol,
    unknown_function,
)
from gbspec.ir.tables import Curve, lookup

Expr = sympy.Expr

NAMES = (
    *("x", "y", "z", "u", "v", "g", "t_", "k", "c", "f", "m", "h", "a", "b", "lambda", "cls", "self", "math", "state"),
    *("condition", "inputs", "constants", "networks", "np", "column", "E", "I", "N", "S", "Q", "O", "beta", "gamma"),
    *("zeta", "μ", "α_1", "K_m", "dx1", "s1", "if1", "x_inside", "phi_2", "None", "class", "def", "in", "is", "nn_a"),
    *("_x", "__y", "exp_", "X", "X_", "Xʹ1", "x1", "x2", "tau", "速度"),
)
"""Names that a user may give, and that would collide with Python, sympy, the generated text or each other."""

ACTIVATIONS = ("silu", "tanh", "softplus", "relu", "gelu", "sigmoid", "elu", "sin")

# Every function is applied where it is smooth and of moderate size, for any real argument.
FUNCTIONS: dict[type[sympy.Basic], Callable[[Expr], Expr]] = {
    sympy.exp: lambda a: sympy.exp(sympy.tanh(a)),
    sympy.log: lambda a: sympy.log(1 + a**2),
    sympy.sin: sympy.sin,
    sympy.cos: sympy.cos,
    sympy.tan: lambda a: sympy.tan(sympy.tanh(a)),
    sympy.tanh: sympy.tanh,
    sympy.sinh: lambda a: sympy.sinh(sympy.tanh(a)),
    sympy.cosh: lambda a: sympy.cosh(sympy.tanh(a)),
    sympy.asin: lambda a: sympy.asin(sympy.tanh(a) / 2),
    sympy.acos: lambda a: sympy.acos(sympy.tanh(a) / 2),
    sympy.atan: sympy.atan,
    sympy.asinh: sympy.asinh,
    sympy.acosh: lambda a: sympy.acosh(2 + sympy.tanh(a)),
    sympy.atanh: lambda a: sympy.atanh(sympy.tanh(a) / 2),
    sympy.Abs: sympy.Abs,
    sympy.sign: sympy.sign,
    sympy.floor: lambda a: sympy.floor(3 * a + sympy.Float(0.37)),  # whole numbers as arguments lie between its jumps
    sympy.cot: lambda a: sympy.cot(1 + sympy.tanh(a) / 2),
    sympy.sec: lambda a: sympy.sec(sympy.tanh(a)),
    sympy.csc: lambda a: sympy.csc(1 + sympy.tanh(a) / 2),
    softplus: softplus,
    logistic: logistic,
}

POWERS: tuple[Callable[[Expr], Expr], ...] = (
    lambda a: sympy.tanh(a) ** 2,
    lambda a: sympy.tanh(a) ** 3,
    lambda a: 1 / (1 + a**2),
    lambda a: (1 + a**2) ** -2,
    lambda a: sympy.sqrt(1 + a**2),
    lambda a: 1 / sympy.sqrt(1 + a**2),
    lambda a: (1 + sympy.tanh(a) ** 2) ** sympy.Rational(1, 3),
    lambda a: (1 + sympy.tanh(a) ** 2) ** sympy.Rational(-3, 2),
    lambda a: 2 ** sympy.tanh(a),
    lambda a: (1 + sympy.tanh(a) ** 2) ** sympy.Float(0.7),
)

BINARY: dict[type[sympy.Basic], Callable[[Expr, Expr], Expr]] = {
    sympy.Add: lambda a, b: a + b,
    sympy.Mul: lambda a, b: sympy.tanh(a) * b,
    sympy.Pow: lambda a, b: (1 + sympy.tanh(a) ** 2) ** sympy.tanh(b),
    sympy.Max: lambda a, b: sympy.Max(a, b, evaluate=False),  # evaluating compares the two by factoring, for seconds
    sympy.Min: lambda a, b: sympy.Min(a, b, evaluate=False),
    sympy.atan2: lambda a, b: sympy.atan2(a, 2 + sympy.tanh(b)),
}

RELATIONS: tuple[type[sympy.Basic], ...] = (
    sympy.StrictLessThan,
    sympy.LessThan,
    sympy.StrictGreaterThan,
    sympy.GreaterThan,
    sympy.Equality,
    sympy.Unequality,
)

CHOICES: tuple[type[sympy.Basic], ...] = (sympy.Piecewise, sympy.And, sympy.Or, sympy.Not)

NUMBERS: tuple[Expr, ...] = (
    sympy.Integer(0),
    sympy.Integer(1),
    sympy.Integer(-3),
    sympy.Rational(1, 3),
    sympy.Rational(-7, 5),
    sympy.Float(0.1),
    sympy.Float(-2.718281828459045),
    sympy.pi,
    sympy.E,
    sympy.sqrt(2),
    sympy.log(10),
)

KINDS = frozenset({*FUNCTIONS, *BINARY, *RELATIONS, *CHOICES})
"""Every kind of node that `expressions` makes, besides symbols, numbers and applications of unknowns."""


@st.composite
def conditions(draw: st.DrawFn, leaf: st.SearchStrategy[Expr], depth: int) -> sympy.Basic:
    """A condition on expressions."""
    kind = draw(st.sampled_from([*RELATIONS, *([sympy.And, sympy.Or, sympy.Not] if depth > 0 else [])]))
    if kind in RELATIONS:
        return kind(draw(expressions(leaf, depth - 1)), draw(expressions(leaf, depth - 1)))
    parts = [draw(conditions(leaf, depth - 1)) for _ in range(1 if kind is sympy.Not else 2)]
    return kind(*parts)


@st.composite
def expressions(draw: st.DrawFn, leaf: st.SearchStrategy[Expr], depth: int = 3) -> Expr:
    """An expression over leaves, finite with moderate derivatives wherever the leaves are."""
    if depth <= 0:
        return draw(leaf)
    below = expressions(leaf, depth - 1)
    match draw(st.sampled_from(("leaf", "function", "power", "binary", "binary", "quotient", "choice", "scaled"))):
        case "leaf":
            return draw(leaf)
        case "function":
            return draw(st.sampled_from([*FUNCTIONS.values()]))(draw(below))
        case "power":
            return draw(st.sampled_from(POWERS))(draw(below))
        case "binary":
            return draw(st.sampled_from([*BINARY.values()]))(draw(below), draw(below))
        case "quotient":
            return draw(below) / (1 + draw(below) ** 2)
        case "scaled":
            return draw(st.sampled_from(NUMBERS)) * draw(below)
    cases = [(draw(below), draw(conditions(leaf, depth - 2))) for _ in range(draw(st.integers(1, 2)))]
    return sympy.Piecewise(*cases, (draw(below), True))


def _take(draw: st.DrawFn, names: list[str], low: int, high: int) -> list[str]:
    return [names.pop() for _ in range(draw(st.integers(low, high)))]


@st.composite
def _networks(draw: st.DrawFn, names: list[str]) -> tuple[list[Network], list[list[str]]]:
    networks = []
    for _ in range(draw(st.integers(0, 2))):
        outputs = tuple(_take(draw, names, 1, 2))
        formals = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=3, unique=True))
        hidden = tuple(draw(st.lists(st.integers(1, 3), min_size=1, max_size=2)))
        ranges = [draw(st.sampled_from((None, Range(-1.0, 3.0), Range(0.0)))) for _ in formals]
        arguments = tuple(Argument(formal, range=span) for formal, span in zip(formals, ranges, strict=True))
        networks.append(Network(outputs, arguments, hidden, draw(st.sampled_from(ACTIVATIONS))))
    return networks, [[a.name for a in network.arguments] for network in networks]


@st.composite
def tables(draw: st.DrawFn, name: str) -> Table:
    """A known function of one argument, whose points lie closer than those at which models are evaluated."""
    steps = draw(st.lists(st.sampled_from((0.21, 0.5, 1.3)), min_size=2, max_size=5))
    places = tuple(float(place) for place in np.cumsum([-1.03, *steps]))
    values = tuple(draw(_moderate) for _ in places)
    return Table(name, ("x",), Curve((places,), values, draw(st.sampled_from(("linear", "pchip", "cubic")))))


@st.composite
def models(draw: st.DrawFn) -> Model:
    """A Model of 1 to 5 states with everything that may occur around them."""
    names = draw(st.permutations(NAMES))
    names = list(names)
    states, given, inputs = (_take(draw, names, low, high) for low, high in ((1, 5), (0, 2), (0, 2)))
    known, learned = _take(draw, names, 0, 2), _take(draw, names, 0, 2)
    networks, formals = draw(_networks(names))
    unknowns = []
    constants = [symbol(name) for name in (*known, *learned)]
    for i, network in enumerate(networks):
        leaf = st.sampled_from([*(symbol(name) for name in formals[i]), *constants])
        for j, output in enumerate(network.outputs):
            form = draw(st.sampled_from(("plain", "plus", "times")))
            wild = draw(expressions(leaf, 2)) if form != "plain" else sympy.S.Zero
            postulate = {"plain": NN, "plus": wild + NN, "times": sympy.tanh(wild) * NN}[form]
            unknowns.append(Unknown(output, network=i, output=j, postulate=postulate, neutral=float(form == "times")))
    plain = [symbol(name) for name in (*states, *given, *inputs, "t")] + constants
    known_functions = [draw(tables(name)) for name in _take(draw, names, 0, 1)]
    leaves = _leaves(plain, networks, known_functions)
    intermediates: list[Intermediate] = []
    whole: dict[sympy.Symbol, Expr] = {}
    for name in _take(draw, names, 0, 3):
        intermediates.append(Intermediate(name, value=draw(expressions(leaves, 2))))
        whole[symbol(name)] = intermediates[-1].value.xreplace(whole)
        if not whole[symbol(name)].has(sympy.ITE):  # a choice that decides a third one: sympy simplifies it for seconds
            leaves = st.one_of(leaves, st.just(symbol(name)))
    channels = [Channel(states[0], value=symbol(states[0]), state=0)]
    channels += [Channel(name, value=draw(expressions(leaves, 2))) for name in _take(draw, names, 0, 1)]
    starts = st.sampled_from([*(symbol(n) for n in (*states[:-1], *given)), *constants, sympy.Integer(2)])
    initial = Initial("expression", draw(expressions(starts, 2))) if draw(st.booleans()) else Initial("measured")
    return Model(
        name="random_model",
        title='A "random" model \\ with """quotes"""',
        states=tuple(State(n, initial=initial if n == states[-1] else Initial("measured")) for n in states),
        conditions=tuple(Condition(name) for name in given),
        inputs=tuple(Input(name, interpolation=draw(st.sampled_from(("held", "linear")))) for name in inputs),
        constants=tuple(Constant(name, value=draw(_moderate)) for name in known),
        learnables=tuple(Learnable(name, start=draw(_moderate)) for name in learned),
        networks=tuple(networks),
        unknowns=tuple(unknowns),
        intermediates=tuple(intermediates),
        balances=tuple(draw(expressions(leaves, 3)) for _ in states),
        channels=tuple(channels),
        doses=(Dose(states[0]),) if draw(st.booleans()) else (),
        tables=tuple(known_functions),
    )


_moderate = st.floats(-2.0, 2.0, allow_nan=False, allow_infinity=False)


def _leaves(plain: Sequence[Expr], networks: Sequence[Network], known: Sequence[Table]) -> st.SearchStrategy[Expr]:
    """Symbols, numbers, and applications of unknowns and of tables to expressions of symbols."""
    simple = st.one_of(st.sampled_from(list(plain)), st.sampled_from(NUMBERS))
    applications = [
        st.lists(
            expressions(st.sampled_from(list(plain)), 1), min_size=len(n.arguments), max_size=len(n.arguments)
        ).map(
            lambda arguments, name=output: unknown_function(name)(*arguments)  # type: ignore[misc]
        )
        for n in networks
        for output in n.outputs
    ]
    applications += [
        expressions(st.sampled_from(list(plain)), 1).map(lookup(table.name, table.curve)) for table in known
    ]
    return st.one_of(simple, simple, *applications) if applications else simple


@dataclass(frozen=True)
class Point:
    """Numbers to evaluate a model at."""

    t: float
    x: NDArray[np.float64]
    condition: NDArray[np.float64]
    inputs: NDArray[np.float64]
    constants: NDArray[np.float64]


def point(model: Model, seed: int) -> Point:
    """A generic point: no two of its numbers are equal or round, so that no comparison is a tie."""
    generator = np.random.default_rng(seed)

    def draw(count: int) -> NDArray[np.float64]:
        return generator.uniform(-2.0, 2.0, count)

    return Point(
        float(draw(1)[0]),
        draw(len(model.states)),
        draw(len(model.conditions)),
        draw(len(model.inputs)),
        draw(len(model.constant_names)),
    )
