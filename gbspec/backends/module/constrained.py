"""The method of a network whose unknowns have contracts: its raw outputs, and the forms that keep the contracts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy

from gbspec.backends.printing import Names, PythonPrinter, temporary
from gbspec.diagnostics import Defect
from gbspec.ir import Expr, Form, Network, Unknown, described, guarantee

WORDS = {"center": "network.center", "scale": "network.scale", "input_scale": "network.input_scale"}
"""Expressions in the generated text for the numbers stored with the weights, by the first word of their symbols."""


class _NumberPrinter(PythonPrinter):
    """Prints Python over plain numbers, for values that do not depend on arguments."""

    def call(self, function: str, *arguments: str) -> str:
        """`max(a, b)`, `_math.log(a)`."""
        word = {"maximum": "max", "minimum": "min"}.get(function, f"_math.{function}")
        return f"{word}({', '.join(arguments)})"


def document(unknowns: Sequence[Unknown]) -> str:
    """The contracts in words, for the method's docstring."""
    return ". ".join(f"{unknown.name} {guarantee(unknown)}" for unknown in unknowns if unknown.contracts)


class Constrained:
    """Writes the body of one network's method. `names` holds the formals; the caller must claim the constants."""

    def __init__(self, network: Network, unknowns: Sequence[Unknown], names: Names) -> None:
        self.network, self.unknowns, self.names = network, unknowns, names
        self.formals = [argument.symbol for argument in network.arguments]
        self.calls: list[tuple[Expr, ...]] = []
        self.raw: dict[tuple[int, int], sympy.Symbol] = {}
        self.numbers: dict[Expr, sympy.Symbol] = {}

    # ---------------------------------------------------------------- expressions
    def values(self) -> list[Expr]:
        """The unknowns in terms of temporaries for raw outputs and numbers, which `calls_of` computes."""
        return [self._value(unknown) for unknown in self.unknowns]

    def _value(self, unknown: Unknown) -> Expr:
        form = unknown.form
        if form is None:
            raise Defect(f"`{unknown.name}` shares a network with contracts but has no form")
        table: dict[sympy.Symbol, sympy.Symbol] = {}
        for symbol in sorted(form.value.free_symbols, key=lambda s: str(s.name)):
            found = described(symbol.name)
            if found is not None and found[0] == "raw":
                table[symbol] = self._raw(form, *found[1])
        return self._without_numbers(form.value.xreplace(table))

    def _raw(self, form: Form, evaluation: int, output: int) -> sympy.Symbol:
        arguments = form.evaluations[evaluation]
        if arguments not in self.calls:
            self.calls.append(arguments)
        key = (self.calls.index(arguments), output)
        if key not in self.raw:
            kinds = [unknown.name for unknown in self.unknowns]
            word = f"raw_{kinds[output]}" if output < len(kinds) else f"gate_{output - len(kinds) + 1}"
            self.raw[key] = temporary(word if key[0] == 0 else f"{word}_there")
        return self.raw[key]

    def _without_numbers(self, node: Expr) -> Expr:
        """The expression with temporaries for its largest parts that do not depend on arguments."""
        symbols = node.free_symbols
        if symbols and all(_is_number(s) for s in symbols):
            if node not in self.numbers:
                word = described(node.name)[0] if node.is_Symbol else "number"  # type: ignore[index]  # checked above
                self.numbers[node] = temporary(word)
            return self.numbers[node]
        if not node.args or not any(_is_number(s) for s in symbols):
            return node
        if isinstance(node, sympy.Add | sympy.Mul):
            known = [a for a in node.args if a.free_symbols and all(_is_number(s) for s in a.free_symbols)]
            others = [self._without_numbers(a) for a in node.args if a not in known]
            return node.func(*others, *([self._without_numbers(node.func(*known))] if known else []))
        return node.func(*map(self._without_numbers, node.args))

    # ---------------------------------------------------------------- text
    @property
    def expressions(self) -> list[Expr]:
        """The arguments of all calls."""
        return [argument for arguments in self.calls for argument in arguments]

    @property
    def temporaries(self) -> set[Expr]:
        """The temporaries in the values: raw outputs and numbers."""
        return {*self.raw.values(), *self.numbers.values()}

    def calls_of(self, index: int, plain: Sequence[str]) -> list[str]:
        """The lines before the values: numbers, and the calls of the network.

        If numbers replace the network, as in a warm start, the generated method executes `plain` instead.
        """
        out = [f"network = networks[{index}]"]
        out += ['if not hasattr(network, "scale"):  # numbers in place of a network, as in a warm start: no contracts']
        out += [f"    {line}" for line in plain]
        printer = _NumberPrinter(self._number)
        out += [f"{self.names.claim(symbol)} = {printer.print(node)}" for node, symbol in self.numbers.items()]
        width = self.network.sizes[-1]
        for call, arguments in enumerate(self.calls):
            targets = [self.names.claim(self.raw[call, i]) if (call, i) in self.raw else "_" for i in range(width)]
            left = f"({targets[0]},)" if width == 1 else ", ".join(targets)
            out.append(f"{left} = network({', '.join(self._arguments(arguments))})")
        return out

    def _number(self, symbol: sympy.Symbol) -> str:
        found = described(symbol.name)
        if found is None:
            raise Defect(f"`{symbol}` is not known before the arguments")
        word, (place,) = found
        return f"{WORDS[word]}[{place}]"

    def _arguments(self, arguments: Sequence[Expr]) -> Iterable[str]:
        """An evaluation's arguments; a constant among others is broadcast to the shape of its formal."""
        printer = PythonPrinter(lambda symbol: self.names[symbol])
        formals = set(self.formals)
        single = not any(argument.free_symbols & formals for argument in arguments)
        for formal, argument in zip(self.formals, arguments, strict=True):
            shaped = single or argument.free_symbols & formals
            yield printer.print(argument) if shaped else printer.print(argument) + f" + 0*{self.names[formal]}"


def _is_number(symbol: sympy.Symbol) -> bool:
    found = described(symbol.name)
    return found is not None and found[0] != "raw"
