"""Formulas of imported models: a small tree, its simplification, and its text in the language.

A formula is a number or a truth value; conditions and numbers are told apart by their heads, so that each is made into
the other only where the source format demands it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

MOST_NODES = 100_000
"""The largest formula that is written."""


@dataclass(frozen=True)
class Formula:
    """A node: its `head` (an operator, `number`, `name`, `time`, `pi`, `if`, `call` of a function
    of the language, `apply` of one of the model), its parts, and a number or a name."""

    head: str
    parts: tuple[Formula, ...] = ()
    value: float = 0.0
    name: str = ""

    @property
    def logical(self) -> bool:
        """Whether it is true or false, and not a number."""
        return self.head in _LOGICAL

    def __add__(self, other: Formula) -> Formula:
        return _sum("+", self, other)

    def __sub__(self, other: Formula) -> Formula:
        return _sum("-", self, other)

    def __mul__(self, other: Formula) -> Formula:
        if self == ONE:
            return other
        return self if other == ONE else Formula("*", (self, other))

    def __truediv__(self, other: Formula) -> Formula:
        return self if other == ONE else Formula("/", (self, other))

    def __pow__(self, other: Formula) -> Formula:
        return Formula("^", (self, other))

    def __neg__(self) -> Formula:
        return number(-self.value) if self.head == "number" else Formula("neg", (self,))


ORDERS = ("<", "<=", ">", ">=")
"""Comparisons by size."""
_COMPARISONS = (*ORDERS, "==")
_LOGICAL = frozenset((*_COMPARISONS, "and", "or", "not", "true", "false"))
_PRECEDENCE = {
    "or": 1, "and": 2, "not": 3, **dict.fromkeys(_COMPARISONS, 4), "+": 5, "-": 5, "*": 6, "/": 6, "neg": 7, "^": 8,
}  # fmt: skip
ATOM = 9


def number(value: float) -> Formula:
    """A number."""
    return Formula("number", value=float(value))


def named(name: str) -> Formula:
    """A quantity by its name."""
    return Formula("name", name=name)


def call(function: str, *arguments: Formula) -> Formula:
    """A function applied to numbers."""
    return Formula("call", tuple(as_number(a) for a in arguments), name=function)


def applied(function: str, *arguments: Formula) -> Formula:
    """A function of the model applied to numbers."""
    return Formula("apply", tuple(as_number(a) for a in arguments), name=function)


def compared(sign: str, left: Formula, right: Formula) -> Formula:
    """A comparison; truth values are equal where both hold or neither does."""
    return Formula(sign, (as_number(left), as_number(right)))


ZERO, ONE, TIME, PI = number(0), number(1), Formula("time"), Formula("pi")
TRUE, FALSE = Formula("true"), Formula("false")


def both(parts: list[Formula]) -> Formula:
    """All conditions hold; without any it is true."""
    kept = [p for p in map(as_condition, parts) if p != TRUE]
    if FALSE in kept:
        return FALSE
    return kept[0] if len(kept) == 1 else Formula("and", tuple(kept)) if kept else TRUE


def either(parts: list[Formula]) -> Formula:
    """One of the conditions holds; without any it is false."""
    kept = [p for p in map(as_condition, parts) if p != FALSE]
    if TRUE in kept:
        return TRUE
    return kept[0] if len(kept) == 1 else Formula("or", tuple(kept)) if kept else FALSE


def negated(part: Formula) -> Formula:
    """The condition does not hold."""
    condition = as_condition(part)
    if condition in (TRUE, FALSE):
        return FALSE if condition == TRUE else TRUE
    return condition.parts[0] if condition.head == "not" else Formula("not", (condition,))


def chosen(condition: Formula, then: Formula, otherwise: Formula) -> Formula:
    """One number or the other."""
    held = as_condition(condition)
    if held in (TRUE, FALSE):
        return then if held == TRUE else otherwise
    return Formula("if", (held, as_number(then), as_number(otherwise)))


def as_number(part: Formula) -> Formula:
    """A truth value as 1 or 0."""
    if part in (TRUE, FALSE):
        return ONE if part == TRUE else ZERO
    return Formula("if", (part, ONE, ZERO)) if part.logical else part


def as_condition(part: Formula) -> Formula:
    """A number as a condition: it holds unless the number is 0."""
    if part.logical:
        return part
    if part.head == "number":
        return FALSE if part.value == 0 else TRUE
    return Formula("not", (compared("==", part, ZERO),))


def _sum(sign: str, left: Formula, right: Formula) -> Formula:
    if right == ZERO:
        return left
    if left == ZERO:
        return right if sign == "+" else -right
    return Formula(sign, (left, right))


def walk(formula: Formula) -> Iterator[Formula]:
    """A formula and all its parts."""
    stack = [formula]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(node.parts)


def names(formula: Formula) -> set[str]:
    """The names in a formula."""
    return {node.name for node in walk(formula) if node.head == "name"}


def substituted(formula: Formula, put: Callable[[Formula], Formula | None]) -> Formula:
    """A formula in which `put` replaces nodes; None leaves a node, whose parts are then looked at."""
    found = put(formula)
    if found is not None:
        return found
    if not formula.parts:
        return formula
    parts = tuple(substituted(part, put) for part in formula.parts)
    return Formula(formula.head, parts, formula.value, formula.name)


def replaced(formula: Formula, table: Mapping[str, Formula]) -> Formula:
    """A formula with other formulas in place of names."""
    return substituted(formula, lambda node: table.get(node.name) if node.head == "name" else None)


def without_factor(formula: Formula, name: str) -> Formula | None:
    """The quotient of a product by one of its factors; None if it is none."""
    if formula == named(name):
        return ONE
    if formula.head == "*":
        for i, part in enumerate(formula.parts):
            rest = without_factor(part, name)
            if rest is not None:
                others = [*formula.parts[:i], *([] if rest == ONE else [rest]), *formula.parts[i + 1 :]]
                out = others[0] if others else ONE
                for other in others[1:]:
                    out = out * other
                return out
    if formula.head == "/":
        rest = without_factor(formula.parts[0], name)
        return None if rest is None else Formula("/", (rest, formula.parts[1]))
    return None


def text(formula: Formula, spelled: Callable[[str], str], time: str) -> str:
    """The text of a formula; `spelled` gives the spelling of a name."""
    return _text(as_number(formula), spelled, time, 0)


def condition_text(formula: Formula, spelled: Callable[[str], str], time: str) -> str:
    """The text of a condition."""
    return _text(as_condition(formula), spelled, time, 0)


def _text(node: Formula, spelled: Callable[[str], str], time: str, outer: int) -> str:
    own = _PRECEDENCE.get(node.head, ATOM)

    def inner(part: Formula, level: int) -> str:
        return _text(part, spelled, time, level)

    match node.head:
        case "number":
            return spelled_number(node.value) if node.value >= 0 or outer < 6 else f"({spelled_number(node.value)})"
        case "name":
            return spelled(node.name)
        case "time" | "pi":
            return time if node.head == "time" else "pi"
        case "true" | "false":
            return "1 == 1" if node.head == "true" else "1 == 0"
        case "call" | "apply":
            name = node.name if node.head == "call" else spelled(node.name)
            return f"{name}({', '.join(inner(p, 0) for p in node.parts)})"
        case "if":
            return f"if({', '.join(inner(p, 0) for p in node.parts)})"
        case "and" | "or":
            found = f" {node.head} ".join(inner(p, own + 1) for p in node.parts)
        case "not":
            found = f"not {inner(node.parts[0], ATOM)}"
        case "neg":
            found = f"-{inner(node.parts[0], own)}"
        case "^":
            found = f"{inner(node.parts[0], ATOM)}^{inner(node.parts[1], ATOM)}"
        case "*" | "/":
            found = f"{inner(node.parts[0], own)}{node.head}{inner(node.parts[1], own + 1)}"
        case _:
            left = own + 1 if node.head in _COMPARISONS else own
            found = f"{inner(node.parts[0], left)} {node.head} {inner(node.parts[1], own + 1)}"
    return f"({found})" if own < outer else found


def spelled_number(value: float) -> str:
    """The shortest text of a number."""
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    return repr(value)
