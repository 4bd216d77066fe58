"""A list of operations as straight C code, and its derivative along a direction (forward mode).

Derivative rules are those of `gbspec.ir.derivatives`, which all other derivatives use too.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import sympy
from sympy.logic.boolalg import Boolean

from gbspec.backends import Call, Flat, Guard, Leaf, Operation, Where
from gbspec.exports.c.printer import PlainC, ascii_text
from gbspec.ir import partials

Place = Callable[[Leaf], str]
STEEP = (sympy.Pow, sympy.log, sympy.exp, sympy.sinh, sympy.cosh, sympy.tan, sympy.asin, sympy.acos, sympy.acosh)
"""Operations whose slope may be infinite or no number where their value is finite."""


class Straight:
    """The body of a C function that computes a list of operations.

    `place` is the C text of a leaf, `direction` that of its part in the direction of a derivative.
    """

    def __init__(self, flat: Flat, place: Place, direction: Place | None = None) -> None:
        self.flat, self.place, self.direction = flat, place, direction
        self._names: dict[sympy.Symbol, str] = {}
        self._tangents: dict[sympy.Basic, str] = {}
        self._calls = 0
        self.printer = PlainC(self._name)

    def body(self, target: str) -> list[str]:
        """Lines that compute the outputs into `target[i]`, or, with a direction, their derivatives."""
        lines = self._leaves()
        for step in self.flat.steps:
            lines += self._operation(step) if isinstance(step, Operation) else self._call(step)
        for i, output in enumerate(self.flat.outputs):
            text = self.printer.print(output) if self.direction is None else self._tangents.get(output, "0.0")
            lines.append(f"{target}[{i}] = {text};")
        return _needed(lines)

    def _name(self, symbol: sympy.Symbol) -> str:
        if symbol not in self._names:
            self._names[symbol] = f"v{len(self._names)}"
        return self._names[symbol]

    def _leaves(self) -> list[str]:
        lines = []
        for symbol, leaf in self.flat.leaves.items():
            lines.append(f"const double {self._name(symbol)} = {self.place(leaf)}; /* {ascii_text(symbol.name)} */")
            if self.direction is not None and leaf.kind != "number":
                self._tangents[symbol] = f"d{self._name(symbol)}"
                lines.append(f"const double d{self._name(symbol)} = {self.direction(leaf)};")
        return lines

    def _operation(self, step: Operation) -> list[str]:
        kind = "int" if isinstance(step.value, Boolean) else "double"
        lines = [f"const {kind} {self._name(step.symbol)} = {self.printer.print(step.value)};"]
        if self.direction is None or kind == "int":
            return lines
        tangent = self._tangent(step)
        if tangent:
            self._tangents[step.symbol] = f"d{self._name(step.symbol)}"
            lines.append(f"const double d{self._name(step.symbol)} = {tangent};")
        return lines

    def _tangent(self, step: Operation) -> str:
        """The derivative of an operation along the direction; empty where it is zero."""
        node = step.value
        if isinstance(node, Guard):
            return self._tangents.get(node.args[1], "")
        if isinstance(node, Where):
            condition, a, b = node.args
            ways = [self._tangents.get(each, "0.0") for each in (a, b)]
            return "" if ways == ["0.0", "0.0"] else f"{self.printer.print(condition)} ? {ways[0]} : {ways[1]}"
        terms = []
        for argument, slope in partials(node, step.symbol):
            tangent = self._tangents.get(argument)
            if tangent is None or slope == 0:
                continue
            if slope == 1:
                terms.append(tangent)
            elif isinstance(node, STEEP):
                terms.append(f"gb_along({self.printer.print(slope)}, {tangent})")
            else:
                terms.append(f"{self.printer.at(slope, ATOM)}*{tangent}")
        return " + ".join(terms)

    def _call(self, step: Call) -> list[str]:
        i, n = self._calls, step.network
        self._calls += 1
        arguments = ", ".join(self.printer.print(a) for a in step.arguments)
        lines = [f"const double a{i}[{len(step.arguments)}] = {{{arguments}}};", f"double y{i}[{len(step.results)}];"]
        tangents = [self._tangents.get(a, "0.0") for a in step.arguments]
        moving = self.direction is not None and set(tangents) != {"0.0"}
        if moving:
            lines.append(f"const double da{i}[{len(tangents)}] = {{{', '.join(tangents)}}};")
            lines += [f"double dy{i}[{len(step.results)}];", f"network_{n}_along(a{i}, da{i}, y{i}, dy{i});"]
        else:
            lines.append(f"network_{n}(a{i}, y{i});")
        for j, symbol in enumerate(step.results):
            lines.append(f"const double {self._name(symbol)} = y{i}[{j}];")
            if moving:
                self._tangents[symbol] = f"dy{i}[{j}]"
        return lines


ATOM = 5
"""The precedence above which a text needs no parentheses."""


DECLARED = re.compile(r"const (?:double|int) (\w+) = ")
NAME = re.compile(r"\b[A-Za-z_]\w*")


def _needed(lines: Sequence[str]) -> list[str]:
    """The lines without declarations of values that no later line reads, which compilers warn of."""
    read: set[str] = set()
    kept = []
    for line in reversed(lines):
        declared = DECLARED.match(line)
        if declared is not None and declared[1] not in read:
            continue
        read.update(NAME.findall(line.partition("/*")[0]))
        kept.append(line)
    return kept[::-1]


def unused(names: Sequence[str], lines: Sequence[str]) -> list[str]:
    """The parameters that no line uses."""
    text = "\n".join(line.partition("/*")[0] for line in lines)
    return [name for name in names if not re.search(rf"\b{name}\b", text)]


def function(head: str, lines: Sequence[str], unused: Sequence[str] = ()) -> list[str]:
    """A static or exported function; parameters that its body does not use are named, so that compilers accept them."""
    return [f"{head} {{", *(f"    (void){name};" for name in unused), *(f"    {line}" for line in lines), "}", ""]
