"""From expressions to a straight list of assignments: each network called once per tuple of arguments, intermediates
under their names, and what occurs more than once computed once.

Identical subexpressions alone are shared; sums and products are not taken apart to find more, so that the statements
still read like the model.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import sympy
from sympy.core.function import AppliedUndef
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.logic.boolalg import Boolean

from gbspec.backends.printing.nodes import Guard, Operation, Temporary, Where, temporary_like
from gbspec.diagnostics import Defect
from gbspec.ir import Model, Network


@dataclass(frozen=True)
class Assignment:
    """`symbol = value`."""

    symbol: sympy.Symbol
    value: sympy.Basic
    wish: str


@dataclass(frozen=True)
class NetworkCall:
    """`results = network(arguments)`: one result an output of the network, None where nothing uses it."""

    network: int
    arguments: tuple[sympy.Expr, ...]
    results: tuple[sympy.Symbol | None, ...]
    wishes: tuple[str, ...]


Statement = Assignment | NetworkCall


def intermediates_of(model: Model) -> list[Assignment]:
    """The model's intermediates under their names."""
    return [Assignment(item.symbol, item.value, item.name) for item in model.intermediates]


RISKY = (sympy.log, sympy.exp, sympy.sinh, sympy.cosh, sympy.tan, sympy.asin, sympy.acos, sympy.acosh, sympy.atanh)
"""Functions whose derivative may be infinite, or overflow, at a finite argument."""


def guarded(node: sympy.Basic) -> sympy.Basic:
    """The expression with every Piecewise as nested `Where`, the symbols of its risky branches behind a `Guard`.

    Nothing is guarded inside an unknown's arguments (a second call of the network would cost more than it saves), nor
    in a `let` that a branch uses: its derivative is taken outside of the choice.
    """
    if not node.has(sympy.Piecewise):
        return node
    if not isinstance(node, sympy.Piecewise):
        return rebuild(node, [guarded(argument) for argument in node.args])
    value: sympy.Expr | None = None
    for i, (branch, condition) in reversed(list(enumerate(node.args))):
        earlier = [sympy.Not(guarded(c), evaluate=False) for _, c in node.args[:i]]
        taken = [*earlier, *([] if condition == sympy.true else [guarded(condition)])]
        text = _guard(guarded(branch), taken[0] if len(taken) == 1 else sympy.And(*taken, evaluate=False))
        if condition == sympy.true:
            value = text
        else:
            value = Where(guarded(condition), text, sympy.nan if value is None else value)
    return value


def _guard(branch: sympy.Basic, taken: sympy.Basic) -> sympy.Basic:
    if not _risky(branch):
        return branch
    return _behind(branch, taken)


def _behind(node: sympy.Basic, taken: sympy.Basic) -> sympy.Basic:
    """Every symbol of a value behind a guard; conditions and unknowns' arguments left as they are."""
    if isinstance(node, sympy.Symbol):
        return Guard(taken, node)
    if isinstance(node, AppliedUndef | Boolean) or not node.args:
        return node
    return rebuild(node, [_behind(argument, taken) for argument in node.args])


def _risky(node: sympy.Basic) -> bool:
    """Whether a derivative within may be infinite or overflow."""
    for part in sympy.preorder_traversal(node):
        if isinstance(part, RISKY) and part.free_symbols:
            return True
        if isinstance(part, sympy.Pow) and part.free_symbols and not (part.exp.is_Integer and part.exp.is_positive):
            return True
    return False


class Program:
    """The statements that compute `outputs` of a model.

    Each output is an assignment to the symbol that the result gets; of `definitions` (the model's intermediates, if not
    given) only those that they need are computed. An application that no network of the model declares is a `Defect`.
    """

    def __init__(
        self, model: Model, outputs: Sequence[Assignment], definitions: Sequence[Assignment] | None = None
    ) -> None:
        self._model = model
        self._definitions = intermediates_of(model) if definitions is None else definitions
        self._networks = {name: (i, net) for i, net in enumerate(model.networks) for name in net.outputs}
        self._calls: dict[tuple[int, tuple[sympy.Expr, ...]], NetworkCall] = {}
        self._pending: dict[sympy.Symbol, Statement] = {}
        self._done: set[sympy.Symbol] = set()
        self.statements: list[Statement] = []
        bodies = self._without_applications(self._bodies(outputs))
        self._share(bodies)
        for body in bodies:
            self._emit(body.symbol)

    def _bodies(self, targets: Sequence[Assignment]) -> list[Assignment]:
        """The targets and, before them, the definitions that they need, choices guarded."""
        table = {item.symbol: item for item in self._definitions}
        needed: set[sympy.Symbol] = set()
        waiting = {symbol for target in targets for symbol in target.value.free_symbols}
        while waiting:
            needed |= waiting
            waiting = {s for name in waiting & table.keys() for s in table[name].value.free_symbols} - needed
        kept = [item for item in self._definitions if item.symbol in needed]
        return [Assignment(item.symbol, guarded(item.value), item.wish) for item in (*kept, *targets)]

    # -------------------------------------------------------------- networks
    def _without_applications(self, bodies: Iterable[Assignment]) -> list[Assignment]:
        return [Assignment(body.symbol, self._replace(body.value), body.wish) for body in bodies]

    def _replace(self, node: sympy.Basic) -> sympy.Basic:
        """The node with each application of an unknown replaced by the symbol of the result."""
        if not node.has(AppliedUndef):
            return node
        arguments = tuple(self._replace(argument) for argument in node.args)
        if isinstance(node, AppliedUndef):
            return self._result(node.func.__name__, arguments)
        return rebuild(node, arguments)

    def _result(self, name: str, arguments: tuple[sympy.Expr, ...]) -> sympy.Symbol:
        if name not in self._networks:
            raise Defect(f"`{name}` is applied but is no unknown of the model `{self._model.name}`")
        index, network = self._networks[name]
        call = self._calls.get((index, arguments)) or NetworkCall(
            index, arguments, (None,) * len(network.outputs), self._wishes(index, network, arguments)
        )
        output = network.outputs.index(name)
        result = call.results[output] or temporary_like(call.wishes[output], *arguments)
        results = (*call.results[:output], result, *call.results[output + 1 :])
        call = NetworkCall(index, arguments, results, call.wishes)
        self._calls[index, arguments] = call
        for symbol in results:
            if symbol is not None:
                self._pending[symbol] = call
        return result

    def _wishes(self, index: int, network: Network, arguments: tuple[sympy.Expr, ...]) -> tuple[str, ...]:
        """`phi` for an application to the declared arguments, `q_h1` for one to other names, else `phi_2`, ..."""
        if arguments == tuple(argument.symbol for argument in network.arguments):
            return network.outputs
        if all(isinstance(argument, sympy.Symbol) for argument in arguments):
            suffix = "_".join(argument.name for argument in arguments)
        else:
            suffix = str(1 + sum(i == index for i, _ in self._calls))
        return tuple(f"{name}_{suffix}" for name in network.outputs)

    # -------------------------------------------------------------- common subexpressions
    def _share(self, bodies: Sequence[Assignment]) -> None:
        """Enters every body, with what occurs more than once in a statement of its own."""
        calls = list(self._calls.values())
        values = [body.value for body in bodies] + [a for call in calls for a in call.arguments]
        counts: Counter[sympy.Basic] = Counter()
        for value in values:
            _count(value, counts)
        table: dict[sympy.Basic, sympy.Basic] = {}
        for body in bodies:
            self._pending[body.symbol] = Assignment(body.symbol, self._extract(body.value, counts, table), body.wish)
        for call in calls:
            arguments = tuple(self._extract(argument, counts, table) for argument in call.arguments)
            final = NetworkCall(call.network, arguments, call.results, call.wishes)
            for symbol in call.results:
                if symbol is not None:
                    self._pending[symbol] = final

    def _extract(
        self, node: sympy.Basic, counts: Mapping[sympy.Basic, int], table: dict[sympy.Basic, sympy.Basic]
    ) -> sympy.Basic:
        if node in table:
            return table[node]
        if not node.args:
            return node
        arguments = [self._extract(argument, counts, table) for argument in node.args]
        rebuilt = node if all(a is b for a, b in zip(arguments, node.args, strict=True)) else rebuild(node, arguments)
        if counts.get(node, 0) > 1:
            wish = _wish(node, sum(isinstance(value, Temporary) for value in table.values()) + 1)
            symbol = temporary_like(wish, rebuilt, real=not isinstance(node, Boolean))
            self._pending[symbol] = Assignment(symbol, rebuilt, wish)
            rebuilt = symbol
        table[node] = rebuilt
        return rebuilt

    # -------------------------------------------------------------- order
    def _emit(self, symbol: sympy.Symbol) -> None:
        """Appends the statement of a symbol after those that it depends on."""
        stack, opened = [symbol], set[sympy.Symbol]()
        while stack:
            top = stack[-1]
            statement = self._pending.get(top)
            if statement is None or top in self._done:
                stack.pop()
                continue
            missing = [s for s in _reads(statement) if s in self._pending and s not in self._done]
            if not missing:
                self.statements.append(statement)
                self._done |= set(_writes(statement))
                stack.pop()
            elif top in opened:
                raise Defect(f"the statements of the model `{self._model.name}` depend on each other in a circle")
            else:
                opened.add(top)
                stack.extend(reversed(missing))


def _reads(statement: Statement) -> list[sympy.Symbol]:
    """The symbols that a statement uses, in a reproducible order."""
    values = (statement.value,) if isinstance(statement, Assignment) else statement.arguments
    found = {symbol for value in values for symbol in value.free_symbols}
    return sorted(found, key=sympy.default_sort_key)


def _writes(statement: Statement) -> list[sympy.Symbol]:
    if isinstance(statement, Assignment):
        return [statement.symbol]
    return [symbol for symbol in statement.results if symbol is not None]


def _count(node: sympy.Basic, counts: Counter[sympy.Basic]) -> None:
    """Counts the occurrences of what is worth a name; inside a repeated part only once."""
    if not node.args or not node.free_symbols:
        return
    if _worth(node):
        counts[node] += 1
        if counts[node] > 1:
            return
    for argument in node.args:
        _count(argument, counts)


def _worth(node: sympy.Basic) -> bool:
    """Whether a part costs more than reading a name: not a small multiple, nor a reciprocal, which is a division."""
    if isinstance(node, sympy.Pow) and node.exp == -1:
        return False
    if isinstance(node, sympy.Mul) and len(node.args) == 2 and node.args[0].is_Number and node.args[1].is_Symbol:
        return False
    return isinstance(node, sympy.Expr | Boolean)


def rebuild(node: sympy.Basic, arguments: Sequence[sympy.Basic]) -> sympy.Basic:
    """The node with other arguments, as it stands: nothing is evaluated anew (of Max, that can take seconds)."""
    if isinstance(node, Where | Guard | Operation | ExprCondPair):
        return node.func(*arguments)
    return node.func(*arguments, evaluate=False)


def _wish(node: sympy.Basic, number: int) -> str:
    """What a shared part would like to be called."""
    if isinstance(node, Guard):
        return f"{node.args[1]}_inside" if node.args[1].is_Symbol else f"inside{number}"
    return f"if{number}" if isinstance(node, Boolean) else f"s{number}"
