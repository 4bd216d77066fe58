"""A model's expressions as a list of single operations and network calls, the form that reverse mode differentiates.

Intermediates, postulates and the forms of contracts are inlined; common subexpressions are computed once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import sympy
from sympy.core.function import AppliedUndef
from sympy.logic.boolalg import Boolean

from gbspec.backends.printing import RECIPROCAL, Guard, Where, guarded, rebuild, temporary
from gbspec.diagnostics import Defect
from gbspec.ir import NN, Expr, Model, Unknown, described, has_rule, ordered

Kind = Literal["state", "condition", "input", "delay", "constant", "time", "number", "algebraic", "side"]


class NotCoveredError(Exception):
    """The model has a form that the kernel does not cover; the message says which."""


@dataclass(frozen=True)
class Leaf:
    """The quantity that a symbol denotes if no operation computes it: entry `index` of a vector. Delayed values stand
    behind the inputs."""

    kind: Kind
    index: int


@dataclass(frozen=True)
class Operation:
    """`symbol = value`; the arguments of `value` are symbols and numbers."""

    symbol: sympy.Symbol
    value: sympy.Basic


@dataclass(frozen=True)
class Call:
    """`results = network(arguments)`: all outputs of the network; the arguments are symbols and numbers."""

    network: int
    arguments: tuple[Expr, ...]
    results: tuple[sympy.Symbol, ...]


Environment = dict[sympy.Basic, sympy.Basic]

MOST_OPERATIONS = 4000
"""Most operations: beyond, compiling straight-line code takes too long, and arrays are faster as torch's vectors."""

MOST_CALLS = 64
"""Most applications of unknowns to different arguments."""

NUMBER_WORDS = ("center", "scale", "input_scale")


def numbers_of(model: Model) -> list[tuple[int, str, int]]:
    """Numbers stored with the weights that forms of contracts use: (network, word, index), in the kernel's order."""
    out = []
    for index, network in enumerate(model.networks):
        for word in NUMBER_WORDS:
            width = network.sizes[0] if word == "input_scale" else network.sizes[-1]
            out += [(index, word, place) for place in range(width)]
    return out


@dataclass
class Flat:
    """The operations and calls that compute `outputs`, in an order in which each follows those it depends on."""

    steps: list[Operation | Call]
    outputs: list[Expr]
    leaves: dict[sympy.Symbol, Leaf]
    calls: list[Call] = field(default_factory=list)


def flatten(
    model: Model, outputs: Sequence[Expr], most_operations: int = MOST_OPERATIONS, most_calls: int = MOST_CALLS
) -> Flat:
    """Flattens expressions of a model. Raises NotCoveredError for a node that has no rule, and beyond the limits."""
    worker = _Flattener(model, most_operations, most_calls)
    values = [worker.value(guarded(node), worker.top) for node in outputs]
    calls = [step for step in worker.steps if isinstance(step, Call)]
    return Flat(worker.steps, values, worker.leaves, calls)


class _Flattener:
    def __init__(self, model: Model, most_operations: int, most_calls: int) -> None:
        self.model = model
        self.most_operations, self.most_calls = most_operations, most_calls
        self.steps: list[Operation | Call] = []
        self.leaves = _leaves(model)
        self.top: Environment = {symbol: symbol for symbol in self.leaves}
        self.intermediates = {item.symbol: item for item in model.intermediates}
        self.unknowns = {unknown.name: unknown for unknown in model.unknowns}
        self._operations: dict[sympy.Basic, sympy.Symbol] = {}
        self._calls: dict[tuple[int, tuple[Expr, ...]], Call] = {}
        self._numbers: dict[tuple[int, str, int], sympy.Symbol] = {}
        for position, key in enumerate(numbers_of(model)):
            self._numbers[key] = temporary("_".join(map(str, key)))
            self.leaves[self._numbers[key]] = Leaf("number", position)

    def value(self, node: sympy.Basic, env: Environment) -> sympy.Basic:
        """The symbol or number that holds a node's value; its operations are appended."""
        if node in env:
            return env[node]
        env[node] = self._value(node, env)
        return env[node]

    def _value(self, node: sympy.Basic, env: Environment) -> sympy.Basic:
        if isinstance(node, sympy.Symbol):
            if env is self.top and node in self.intermediates:
                return self.value(guarded(self.intermediates[node].value), env)
            if node in self.leaves and self.leaves[node].kind == "constant":
                return node
            raise Defect(f"no statement computes `{node}` in the model `{self.model.name}`")
        if not node.has(sympy.Symbol, AppliedUndef):
            return node
        if isinstance(node, AppliedUndef):
            return self._unknown(node.func.__name__, tuple(self.value(a, env) for a in node.args))
        if isinstance(node, sympy.Max | sympy.Min):
            return self._fold(node.func, [self.value(a, env) for a in ordered(node)])
        arguments = [self.value(argument, env) for argument in node.args]
        if isinstance(node, sympy.Pow):
            return self._power(*arguments)
        if type(node) in RECIPROCAL:
            return self._power(self._enter(getattr(sympy, RECIPROCAL[type(node)])(*arguments, evaluate=False)), -1)
        if not (has_rule(node) or isinstance(node, Where | Guard | Boolean)):
            raise NotCoveredError(f"it has no rule for `{type(node).__name__}`")
        return self._enter(rebuild(node, arguments))

    def _enter(self, node: sympy.Basic) -> sympy.Basic:
        """The symbol of an operation on atoms."""
        if not node.free_symbols:
            return node
        if node not in self._operations:
            if len(self.steps) > self.most_operations:
                raise NotCoveredError(f"its equations have more than {self.most_operations} operations")
            symbol = temporary("v", real=not isinstance(node, Boolean))
            self.steps.append(Operation(symbol, node))
            self._operations[node] = symbol
        return self._operations[node]

    def _fold(self, function: type[sympy.Basic], arguments: Sequence[sympy.Basic]) -> sympy.Basic:
        first, *rest = arguments
        for argument in rest:
            first = self._enter(function(first, argument, evaluate=False))
        return first

    def _power(self, base: sympy.Basic, exponent: sympy.Basic | int) -> sympy.Basic:
        """A power; negative exponents become reciprocals, as they are printed."""
        exponent = sympy.sympify(exponent)
        if exponent.is_Rational and exponent.is_negative and exponent != -1:
            base, exponent = self._power(base, -exponent), sympy.S.NegativeOne
        if exponent == 1:
            return base
        return self._enter(sympy.Pow(base, exponent, evaluate=False))

    # -------------------------------------------------------------- unknowns
    def _unknown(self, name: str, arguments: tuple[Expr, ...]) -> sympy.Basic:
        """The value of an unknown at atoms: a call of its network, in its postulate or the form of its contracts."""
        if name not in self.unknowns:
            raise Defect(f"`{name}` is applied but is no unknown of the model `{self.model.name}`")
        unknown = self.unknowns[name]
        network = self.model.networks[unknown.network]
        formals: Environment = {a.symbol: v for a, v in zip(network.arguments, arguments, strict=True)}
        if unknown.form is None:
            env = formals | {NN: self._call(unknown.network, arguments)[unknown.output]}
            return self.value(guarded(unknown.postulate), env)
        return self._formed(unknown, formals)

    def _formed(self, unknown: Unknown, formals: Environment) -> sympy.Basic:
        form = unknown.form
        if form is None:
            raise Defect(f"`{unknown.name}` has no form")
        env = dict(formals)
        for symbol in sorted(form.value.free_symbols, key=lambda s: str(s.name)):
            found = described(symbol.name)
            if found is None:
                continue
            word, places = found
            if word == "raw":
                evaluation, output = places
                point = tuple(self.value(node, dict(formals)) for node in form.evaluations[evaluation])
                env[symbol] = self._call(unknown.network, point)[output]
            else:
                env[symbol] = self._numbers[unknown.network, word, places[0]]
        return self.value(guarded(form.value), env)

    def _call(self, network: int, arguments: tuple[Expr, ...]) -> tuple[sympy.Symbol, ...]:
        key = (network, arguments)
        if key not in self._calls:
            if len(self._calls) >= self.most_calls:
                raise NotCoveredError(f"it applies unknowns to more than {self.most_calls} tuples of arguments")
            outputs = self.model.networks[network].sizes[-1]
            call = Call(network, arguments, tuple(temporary("y") for _ in range(outputs)))
            self.steps.append(call)
            self._calls[key] = call
        return self._calls[key].results


def _leaves(model: Model) -> dict[sympy.Symbol, Leaf]:
    groups: Iterable[tuple[Kind, Sequence[sympy.Symbol]]] = (
        ("state", [item.symbol for item in model.states]),
        ("condition", [item.symbol for item in model.conditions]),
        ("input", [item.symbol for item in model.inputs]),
        ("delay", [item.symbol for item in model.delays]),
        ("constant", [item.symbol for item in (*model.constants, *model.learnables)]),
        ("time", [model.time.symbol]),
        ("algebraic", [item.symbol for item in model.algebraics]),
        ("side", [item.symbol for item in model.switches]),
    )
    return {symbol: Leaf(kind, i) for kind, symbols in groups for i, symbol in enumerate(symbols)}
