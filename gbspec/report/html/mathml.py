"""A model's equations in presentation MathML, which browsers typeset without additional scripts or fonts."""
# ruff: noqa: N802 - sympy finds a printer's methods by the names of its classes

from __future__ import annotations

import re
from xml.dom.minidom import Element
from xml.sax.saxutils import escape

import sympy
from sympy.printing.mathml import MathMLPresentationPrinter

from gbspec.ir import NN, Diffusion, Expr, Lookup, Model, Timing, Unknown, named

_ENTITIES = {"&InvisibleTimes;": "&#x22C5;", "&ExponentialE;": "e", "&ApplyFunction;": "&#x2061;"}
"""The printer's named entities as numbers, so that the page is well formed as XML too."""


class _Printer(MathMLPresentationPrinter):  # type: ignore[misc]  # sympy is untyped
    """sympy's printer with unknown functions by their names, floats in full, and pieces under a brace."""

    def _print_Float(self, expr: sympy.Float) -> Element:
        digits, _, exponent = repr(float(expr)).partition("e")
        number = self._leaf("mn", digits.removesuffix(".0"))
        if not exponent:
            return number
        power = self.dom.createElement("msup")
        power.appendChild(self._leaf("mn", "10"))
        power.appendChild(self._leaf("mn", str(int(exponent))))
        return self._row(number, self._leaf("mo", "·"), power)

    def _print_Piecewise(self, expr: sympy.Piecewise) -> Element:
        table = self.dom.createElement("mtable")
        for value, condition in expr.args:
            line = self.dom.createElement("mtr")
            when = self._leaf("mtext", "otherwise") if condition == sympy.true else self._print(condition)
            for cell in (self._print(value), when):
                box = self.dom.createElement("mtd")
                box.appendChild(cell)
                line.appendChild(box)
            table.appendChild(line)
        return self._row(self._leaf("mo", "{"), table)

    def _print_Function(self, expr: sympy.Basic) -> Element:
        if isinstance(expr, Lookup):  # sympy does not look for a method named after a base of a function's class
            return self._applied(expr.table, expr)
        if not isinstance(expr, sympy.core.function.AppliedUndef):
            printed: Element = super()._print_Function(expr)
            return printed
        return self._applied(expr.func.__name__, expr)

    def _applied(self, function: str, expr: sympy.Basic) -> Element:
        inside: list[Element] = []
        for argument in expr.args:
            inside += ([self._leaf("mo", ",")] if inside else []) + [self._print(argument)]
        name = self._print(sympy.Symbol(function))
        return self._row(name, self._leaf("mo", "("), *inside, self._leaf("mo", ")"))

    def _print_Element(self, expr: sympy.Basic) -> Element:
        element: Element = self.dom.createElement("msub")
        element.appendChild(self._print(expr.args[0]))
        element.appendChild(self._print(expr.args[1]))
        return element

    def _print_Total(self, expr: sympy.Basic) -> Element:
        return self._row(self._leaf("mo", "∑"), self._print(expr.args[0]))

    def _leaf(self, tag: str, text: str) -> Element:
        leaf: Element = self.dom.createElement(tag)
        leaf.appendChild(self.dom.createTextNode(text))
        return leaf

    def _row(self, *parts: Element) -> Element:
        row: Element = self.dom.createElement("mrow")
        for part in parts:
            row.appendChild(part)
        return row


def expression(value: Expr | sympy.Basic) -> str:
    """An expression, without the surrounding `math` element."""
    text = str(_Printer().doprint(value))
    # sympy's printer does not escape the sign of a relation
    text = text.replace("<mo><</mo>", "<mo>&lt;</mo>").replace("<mo>></mo>", "<mo>&gt;</mo>")
    return re.sub(r"&[A-Za-z]+;", lambda found: _ENTITIES.get(found[0], found[0]), text)


def name(text: str) -> str:
    """A declared name: Greek letters and indices are recognised."""
    return expression(sympy.Symbol(text))


def inline(text: str) -> str:
    """A name within a line of text."""
    return f"<math>{name(text)}</math>"


def equations(pairs: list[tuple[str, str]], sign: str = "=") -> str:
    """Equations below each other, aligned at their signs."""
    rows = "".join(
        f'<mtr><mtd style="text-align:right">{left}</mtd><mtd><mo>{sign}</mo></mtd>'
        f'<mtd style="text-align:left">{right}</mtd></mtr>'
        for left, right in pairs
    )
    return f'<math display="block"><mtable displaystyle="true">{rows}</mtable></math>'


def balances(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each balance; of a state with a random disturbance, of its increment."""
    time, disturbed = f"<mi>d</mi>{name(model.time.name)}", {d.state: d for d in model.diffusions}
    found = []
    for left, right in model.equations("balances"):
        change, value = f"<mi>d</mi>{expression(left)}", model.timed(right)
        if left.is_Symbol and left.name in disturbed:
            drift = "" if value == 0 else f"{_factor(value)}{time}<mo>+</mo>"
            found.append((f"<mrow>{change}</mrow>", f"<mrow>{drift}{_increment(model, disturbed[left.name])}</mrow>"))
        else:
            fraction = f"<mfrac><mrow>{change}</mrow><mrow>{time}</mrow></mfrac>"
            found.append((fraction, expression(value)))
    return found + [(expression(left), expression(right)) for left, right in model.equations("closures")]


def disturbances(model: Model) -> list[tuple[str, str]]:
    """Left and right side of the increment of each disturbed state of an array, whose balances stand together."""
    time = f"<mi>d</mi>{name(model.time.name)}"
    alone = {left.name for left, _ in model.equations("balances") if left.is_Symbol}
    found = []
    for one in model.diffusions:
        state = name(one.state)
        if one.state not in alone:
            rate = f"<mfrac><mrow><mi>d</mi>{state}</mrow><mrow>{time}</mrow></mfrac>"
            mean = f"<msub><mrow><mo>(</mo>{rate}<mo>)</mo></mrow><mtext>balance</mtext></msub>"
            right = f"<mrow>{mean}{time}<mo>+</mo>{_increment(model, one)}</mrow>"
            found.append((f"<mrow><mi>d</mi>{state}</mrow>", right))
    return found


def _increment(model: Model, one: Diffusion) -> str:
    """The size of a disturbance times the increment of its Wiener process."""
    return f"{_factor(model.timed(one.value))}<mi>d</mi><msub><mi>W</mi>{name(one.state)}</msub>"


def _factor(value: Expr) -> str:
    """An expression as a factor, a sum or pieces in parentheses."""
    text = expression(value)
    return f"<mo>(</mo>{text}<mo>)</mo>" if value.is_Add or value.is_Piecewise else text


def algebraic(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each algebraic equation."""
    return [(expression(equation.left), expression(equation.right)) for equation in model.constraints]


def intermediates(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each named expression."""
    return [(expression(left), expression(model.timed(right))) for left, right in named(model)]


def observations(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each channel that is not simply a state."""
    return [(expression(left), expression(model.timed(right))) for left, right in model.equations("channels")]


def events(model: Model) -> list[tuple[str, str]]:
    """When each event happens, and what it sets."""
    found = []
    for event in model.events:
        when = expression(event.condition) if event.timing is None else _times(model, event.timing)
        values = (f"{name(state)}<mo>≔</mo>{expression(value)}" for state, value in event.values)
        label = f"<mtext>{escape(event.name)}:&#160;</mtext>"
        found.append((f"<mrow>{label}{when}</mrow>", f"<mrow>{'<mo>,</mo>'.join(values)}</mrow>"))
    return found


def _times(model: Model, timing: Timing) -> str:
    """The times of an event: its first one, then every so often, up to the last."""
    parts = [name(model.time.name), "<mo>=</mo>"]
    parts.append("<mtext>start</mtext>" if timing.at is None else expression(timing.at))
    if timing.every is not None:
        parts += ["<mo>+</mo><mi>n</mi><mo>⋅</mo><mo>(</mo>", expression(timing.every), "<mo>)</mo>"]
    if timing.until is not None:
        parts += ["<mo>≤</mo>", expression(timing.until)]
    return "".join(parts)


def starts(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each initial value that the model gives by an expression."""
    at = "<mn>0</mn>" if model.time.start is None else f"<mn>{escape(f'{model.time.start:g}')}</mn>"
    return [
        (f"<msub>{expression(left)}<mrow>{at}</mrow></msub>", expression(right))
        for left, right in model.equations("starts")
    ]


def histories(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each state before the start that the model gives."""
    return [
        (f"{name(s.name)}<mo>(</mo>{name(model.time.name)}<mo>)</mo>", expression(s.history))
        for s in model.states
        if s.history is not None
    ]


def postulate(model: Model, unknown: Unknown) -> tuple[str, str]:
    """Left and right side of an unknown: its postulated form, with the network as a calligraphic N."""
    arguments = [a.symbol for a in model.networks[unknown.network].arguments]
    formals = "<mo>,</mo>".join(name(a.name) for a in arguments)
    network = f"<mrow><mi>𝒩</mi><mo>(</mo>{formals}<mo>)</mo></mrow>"
    right = expression(unknown.postulate).replace(name(NN.name), network)
    return f"{name(unknown.name)}<mo>(</mo>{formals}<mo>)</mo>", right
