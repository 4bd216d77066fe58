"""Proves `conserve` claims for all unknown functions, or refutes them with the remaining terms.

The rate of a quantity Q(x, t) along the balances x' = f is the sum of dQ/dx_i f_i plus dQ/dt. That it equals the
claimed rate is an identity, decided in three steps of growing cost: with process rates as free symbols, with all
intermediates substituted, and with the constants at their values. In each, applications of unknowns are free symbols,
and an expression that does not cancel symbolically is evaluated at random points to 50 digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import sympy

from gbspec.diagnostics import Findings, Label
from gbspec.ir import Claim, Expr, Model, between_jumps, uninfused
from gbspec.passes.conservation import as_text
from gbspec.passes.terms import Opened, branching, constants_of, exact, terms

DIGITS = 50
POINTS = 6
ROUNDING = sympy.Float("1e-12")
"""With constants at their values, a sum below this fraction of its largest term counts as rounding."""

_NOTHING: Mapping[sympy.Symbol, Expr] = {}


class Verdict(Enum):
    """The result of deciding an identity."""

    HOLDS = "holds"
    FAILS = "fails"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Decision:
    """The verdict on a claim, and for one that fails the difference of the rates."""

    claim: Claim
    verdict: Verdict
    difference: Expr = sympy.S.Zero


def check_claims(model: Model, findings: Findings) -> None:
    """Decides every claim; reports those that fail (GB330), contain an input (GB332) or are undecided (GB331)."""
    for claim in model.claims:
        inputs = [i.name for i in model.inputs if i.symbol in model.inlined([claim.value])[0].free_symbols]
        if inputs:
            findings.error(
                "GB332",
                f"`{claim.name}` contains the input `{inputs[0]}`, whose rate of change is unknown",
                claim.span,
                help="state the claim in terms of states; an input may occur after `rate`",
                subject=claim.name,
            )
            continue
        decision = decide(model, claim)
        if decision.verdict is Verdict.FAILS:
            _refuted(model, decision, findings)
        elif decision.verdict is Verdict.UNDECIDED and not model.accepts("GB331", claim.name):
            findings.warning(
                "GB331",
                f"could not decide whether `{claim.name}` is conserved",
                claim.span,
                help=f"simplify its expressions, or accept it with `allow GB331 {claim.name}`",
                subject=claim.name,
            )


def decide(model: Model, claim: Claim) -> Decision:
    """Whether the claim holds for every state, time, constant and unknown function."""
    free = _difference(model, claim, uninfused(model), claim.value, claim.rate)
    solved = {item.symbol for item in model.algebraics}
    *balances, value, rate = model.inlined([*uninfused(model), claim.value, claim.rate])
    kept = Verdict.UNDECIDED if value.has(sympy.floor) else Verdict.HOLDS  # its rate says nothing of its jumps
    if free is not None and not claim.value.free_symbols & solved and _vanishes(model, free) is Verdict.HOLDS:
        return Decision(claim, kept)
    whole = _difference(model, claim, balances, value, rate)
    assert whole is not None
    verdict = _vanishes(model, whole)
    if value.free_symbols & solved:  # how these change is not known
        return Decision(claim, Verdict.UNDECIDED, whole)
    if verdict is not Verdict.HOLDS:
        numbers = {c.symbol: sympy.Rational(repr(c.value)) for c in model.constants}
        if numbers and _vanishes(model, whole, numbers) is Verdict.HOLDS:
            verdict = Verdict.HOLDS
    if verdict is Verdict.FAILS and whole.free_symbols & solved:  # the equations may make it zero all the same
        verdict = Verdict.UNDECIDED
    return Decision(claim, kept if verdict is Verdict.HOLDS else verdict, whole)


def _difference(model: Model, claim: Claim, balances: Sequence[Expr], value: Expr, rate: Expr) -> Expr | None:
    """The rate of `value` minus the claimed rate; None if `value` still contains intermediates."""
    if value.free_symbols & {i.symbol for i in model.intermediates}:
        return None
    parts = [between_jumps(value, s.symbol) * balance for s, balance in zip(model.states, balances, strict=True)]
    return sympy.Add(*parts, between_jumps(value, model.time.symbol), -rate)


# ------------------------------------------------------------------------------------------------------- identities


def _vanishes(model: Model, expression: Expr, numbers: Mapping[sympy.Symbol, Expr] = _NOTHING) -> Verdict:
    """Whether an expression is zero for all values of its symbols, those in `numbers` at their values."""
    opened = Opened(constants_of(model))
    plain = opened.open(expression)
    table = opened.split(plain)
    if not table:
        return Verdict.HOLDS
    opaque = {atom: sympy.Dummy(real=True) for atom in branching(plain)}
    if _zero_at_points(_outermost(plain, opaque), numbers):
        return Verdict.HOLDS
    if not opaque:
        return Verdict.FAILS
    return Verdict.UNDECIDED if _zero_at_points(plain, numbers) else Verdict.FAILS


def _outermost(expression: Expr, opaque: dict[Expr, sympy.Dummy]) -> Expr:
    """Replaces the outermost expressions with branches by free symbols: an identity in them holds on every branch."""
    return expression.xreplace(opaque) if opaque else expression


def _zero_at_points(expression: Expr, numbers: Mapping[sympy.Symbol, Expr]) -> bool:
    tolerance = ROUNDING if numbers else sympy.Float(f"1e-{DIGITS - 15}", DIGITS)
    parts = terms(exact(expression))
    symbols = sorted(expression.free_symbols, key=sympy.default_sort_key)
    for point in range(POINTS):
        place = {s: numbers.get(s, _coordinate(point, i)) for i, s in enumerate(symbols)}
        values = [term.xreplace(place) for term in parts]
        total = sympy.Add(*values)
        if total == 0:
            continue
        size = sympy.Add(*(abs(value) for value in values)).evalf(DIGITS)
        if not size.is_number or not size.is_finite:
            continue
        if abs(total.evalf(DIGITS)) > size * tolerance:
            return False
    return True


def _coordinate(point: int, index: int) -> Expr:
    """Coordinates between 0.2 and 3, by the golden ratio: far from special values, and deterministic."""
    fraction = (sympy.Rational(6180339887, 10**10) * (point * 101 + index * 7 + 1)) % 1
    return sympy.Rational(1, 5) + fraction * sympy.Rational(14, 5)


# -------------------------------------------------------------------------------------------------------- reporting


def _refuted(model: Model, decision: Decision, findings: Findings) -> None:
    claim = decision.claim
    opened = Opened(constants_of(model))
    remains = opened.split(opened.open(decision.difference))
    shown = _sum_as_text(_terms(remains, opened))
    places = [
        Label(state.span, "its balance contributes this")
        for state, balance in zip(model.states, model.inlined(model.balances), strict=True)
        if state.span is not None
        and set(remains) & set(opened.split(opened.open(_contribution(model, claim, state.symbol, balance))))
    ]
    than = "0" if claim.rate == 0 else f"`{as_text(claim.rate)}`"
    total = opened.split(opened.open(decision.difference + model.inlined([claim.rate])[0]))
    rate = _sum_as_text(_terms(total, opened)) if total else "0"
    findings.error(
        "GB330",
        f"`{claim.name}` does not change at the claimed rate"
        if claim.rate != 0
        else f"`{claim.name}` is not conserved",
        claim.span,
        label=f"{shown} remains",
        labels=places[:4],
        notes=[f"its rate of change is {rate}, not {than}"],
        help="correct a balance, or the claim"
        + (f": `conserve {claim.name} = … rate {rate.strip('`')}`" if len(rate) < 60 and "…" not in rate else ""),
        subject=claim.name,
    )


def _terms(table: Mapping[Expr, Expr], opened: Opened) -> list[Expr]:
    """The terms of a split expression in the user's names, the simplest first."""
    return sorted((opened.close(key * coefficient) for key, coefficient in table.items()), key=lambda e: e.count_ops())


def _contribution(model: Model, claim: Claim, state: sympy.Symbol, balance: Expr) -> Expr:
    return between_jumps(model.inlined([claim.value])[0], state) * balance


def _sum_as_text(parts: Sequence[Expr], most: int = 3) -> str:
    text = " + ".join(as_text(part) for part in parts[:most]).replace("+ -", "- ")
    return f"`{text}`" if len(parts) <= most else f"`{text} + …` ({len(parts)} terms)"
