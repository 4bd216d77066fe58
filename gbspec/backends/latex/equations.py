"""Names and expressions of a model in LaTeX's mathematics."""
# ruff: noqa: N802, N815 - sympy finds a printer's methods by the names of its classes

from __future__ import annotations

import re
import unicodedata

import sympy
from sympy.printing.latex import LatexPrinter

from gbspec.ir import NN, Expr, Lookup, Model, Timing, Unknown, named

GREEK = frozenset(
    (
        *("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa", "lambda", "mu", "nu"),
        *("xi", "pi", "rho", "sigma", "tau", "upsilon", "phi", "chi", "psi", "omega", "Gamma", "Delta", "Theta"),
        *("Lambda", "Xi", "Pi", "Sigma", "Upsilon", "Phi", "Psi", "Omega"),
    )
)
"""Greek letters that LaTeX has commands for; the others look like Latin letters."""


def name(text: str) -> str:
    """A declared name: `x1` becomes x with index 1, `mu_max` a Greek letter with an upright index, `Da` upright.

    A name of several words, such as `host_growth`, is one upright word.
    """
    parts = [part for part in text.split("_") if part]
    if not parts or (len(parts) > 1 and len(parts[0]) > 2 and parts[0].isalpha() and parts[0] not in GREEK):
        return f"\\mathrm{{{text.replace('_', chr(92) + '_')}}}"
    split = re.fullmatch(r"(.*\D)(\d+)", parts[0])
    if split:
        parts[:1] = [split[1], split[2]]
    indices = ",".join(map(_word, parts[1:]))
    return f"{_word(parts[0])}_{{{indices}}}" if indices else _word(parts[0])


def _word(part: str) -> str:
    """A Greek letter, a single letter or a number unchanged; a longer word upright."""
    if len(part) == 1 and "GREEK" in unicodedata.name(part, ""):
        kind, _, letter = unicodedata.name(part).removeprefix("GREEK ").partition(" LETTER ")
        part = letter.capitalize() if kind == "CAPITAL" else letter.lower()
        part = "lambda" if part == "lamda" else "Lambda" if part == "Lamda" else part
    if part in GREEK:
        return f"\\{part}"
    return part if len(part) == 1 or part.isdecimal() else f"\\mathrm{{{part}}}"


class _Printer(LatexPrinter):  # type: ignore[misc]  # sympy is untyped
    """sympy's printer with this project's names, unknown functions, and floats in full."""

    def _print_Symbol(self, expr: sympy.Symbol, style: str = "plain") -> str:
        return r"\mathcal{N}" if expr == NN else name(expr.name)

    _print_Dummy = _print_Symbol

    def _print_Element(self, expr: sympy.Basic) -> str:
        return f"{name(expr.args[0].name)}_{{{self._print(expr.args[1])}}}"

    def _print_Total(self, expr: sympy.Basic) -> str:
        return f"\\sum_{{i}} {name(expr.args[0].name)}_{{i}}"

    def _print_Float(self, expr: sympy.Float) -> str:
        digits, _, exponent = repr(float(expr)).partition("e")
        return f"{digits.removesuffix('.0')} \\cdot 10^{{{int(exponent)}}}" if exponent else digits.removesuffix(".0")

    def _print_Function(self, expr: sympy.Basic, exp: str | None = None) -> str:
        if isinstance(expr, Lookup):  # sympy does not look for a method named after a base of a function's class
            return self._applied(expr.table, expr, exp)
        if not isinstance(expr, sympy.core.function.AppliedUndef):
            return str(super()._print_Function(expr, exp))
        return self._applied(expr.func.__name__, expr, exp)

    def _applied(self, function: str, expr: sympy.Basic, exp: str | None) -> str:
        arguments = ", ".join(map(self._print, expr.args))
        power = f"^{{{exp}}}" if exp is not None else ""
        return f"{name(function)}{power}\\left({arguments}\\right)"


_PRINTER = _Printer({"mul_symbol": r" \, ", "fold_short_frac": False, "ln_notation": True})


def expression(value: Expr | sympy.Basic) -> str:
    """An expression or a condition."""
    return str(_PRINTER.doprint(value))


def balances(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each balance."""
    time = name(model.time.name)
    found = [
        (f"\\frac{{\\mathrm{{d}} {expression(left)}}}{{\\mathrm{{d}} {time}}}", expression(model.timed(balance)))
        for left, balance in model.equations("balances")
    ]
    return found + [(expression(left), expression(value)) for left, value in model.equations("closures")]


def algebraic(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each algebraic equation."""
    return [(expression(equation.left), expression(equation.right)) for equation in model.constraints]


def disturbances(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each random disturbance: what it adds to the increment of its state."""
    return [
        (f"\\mathrm{{d}} {name(d.state)} - \\dot{{{name(d.state)}}} \\, \\mathrm{{d}} {name(model.time.name)}",
         f"{expression(d.value)} \\, \\mathrm{{d}} W_{{{name(d.state)}}}")
        for d in model.diffusions
    ]  # fmt: skip


def intermediates(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each named expression."""
    return [(expression(left), expression(model.timed(value))) for left, value in named(model)]


def observations(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each channel that is not simply a state."""
    return [(expression(left), expression(model.timed(value))) for left, value in model.equations("channels")]


def events(model: Model) -> list[tuple[str, str]]:
    """What each event sets, and its condition or times."""
    found = []
    for event in model.events:
        when = expression(event.condition) if event.timing is None else _times(model, event.timing)
        values = r", \ ".join(f"{name(state)} := {expression(value)}" for state, value in event.values)
        found.append((rf"{name(event.name)}: \quad {when}", rf"\Rightarrow {values}"))
    return found


def _times(model: Model, timing: Timing) -> str:
    """The times of an event: its first one, then every so often, up to the last."""
    text = f"{name(model.time.name)} = " + (r"\text{start}" if timing.at is None else expression(timing.at))
    if timing.every is not None:
        text += rf" + n \cdot \left({expression(timing.every)}\right)"
    return text if timing.until is None else rf"{text} \le {expression(timing.until)}"


def starts(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each initial value that the model gives by an expression, or from which a steady state is
    reached."""
    steady = {s.symbol for s in model.states if s.initial.kind == "steady"}
    at = "0" if model.time.start is None else expression(sympy.Float(model.time.start, 17))
    return [
        (
            f"{expression(left)}({'t_{0}' if model.time.start is None else at})",
            expression(value) + (r"\ \text{and on to the steady state}" if left in steady else ""),
        )
        for left, value in model.equations("starts")
    ]


def histories(model: Model) -> list[tuple[str, str]]:
    """Left and right side of each state before the start that the model gives."""
    time = name(model.time.name)
    first = "t_{0}" if model.time.start is None else expression(sympy.Float(model.time.start, 17))
    return [
        (f"{name(s.name)}({time})", f"{expression(s.history)} \\quad \\text{{for }} {time} < {first}")
        for s in model.states
        if s.history is not None
    ]


def postulate(model: Model, unknown: Unknown) -> tuple[str, str]:
    """Left and right side of an unknown in terms of its network, written as a calligraphic N with the output's name."""
    formals = ", ".join(name(argument.name) for argument in model.networks[unknown.network].arguments)
    network = f"\\mathcal{{N}}_{{{name(unknown.name)}}}\\left({formals}\\right)"
    right = expression(unknown.postulate).replace(r"\mathcal{N}", network)
    return f"{name(unknown.name)}\\left({formals}\\right)", right
