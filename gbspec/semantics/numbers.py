"""Checks all fixed numbers: constants, ranges, bounds, starting and initial values, defaults, noise, priors."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import assert_never

from gbspec.diagnostics import Findings, Label, Span
from gbspec.ir import WITH_DENSITY
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.graph import Graph
from gbspec.semantics.merge import Item
from gbspec.semantics.sites import Site, Sites
from gbspec.semantics.table import Table
from gbspec.syntax import CONST_VALUE, Kind, ast

GEOMETRIC_FROM = 100.0
"""From this ratio of positive bounds on, the default starting value of a learnable is the bounds' geometric mean."""


def functions_of(table: Table) -> dict[str, ast.FunctionStatement]:
    """The declared functions."""
    return {n: d.statement for n, d in table.items() if isinstance(d.statement, ast.FunctionStatement)}


def constants(sites: Iterable[Site], graph: Graph, table: Table, findings: Findings) -> dict[str, float]:
    """The values of the constants; reports all sub-expressions that are finite for no value of the variables."""
    values: dict[str, float] = {}
    wrong: list[ast.Expression] = []
    sites = list(sites)
    by_owner = {s.owner: s for s in sites if s.rule is CONST_VALUE and s.references.complete}

    def not_finite(node: ast.Expression, value: float, by_zero: bool) -> None:
        wrong.append(node)
        what = "not a real number" if math.isnan(value) else "not a finite number"
        findings.error(
            "GB223", f"this is {what}", node.span, label="a division by zero" if by_zero else _reason(node, value)
        )

    evaluate = Evaluator(values, functions_of(table), not_finite)
    for name in graph.order:
        if table[name].kind is Kind.CONST and name in by_owner and name not in graph.broken:
            site, count = by_owner[name], len(wrong)
            value = evaluate(site.expression)
            if value is not None:
                values[name] = value
            elif len(wrong) == count and all(n in values for n in site.references.names if table[n].kind is Kind.CONST):
                _not_known(site.expression, name, findings)
    for site in sites:
        if site.rule is not CONST_VALUE and site.references.complete:
            evaluate(site.expression, dict.fromkeys(site.formals))
    return values


def _not_known(node: ast.Expression, name: str, findings: Findings) -> None:
    findings.error("GB223", f"the value of `{name}` is not a finite number", node.span)


def _reason(node: ast.Expression, value: float) -> str:
    match node:
        case ast.Call(function=function):
            return f"`{function.text}` has no value there"
        case ast.Binary(operator="^") if math.isnan(value):
            return "no real power"
        case _:
            return "too large for double precision"


@dataclass
class Numbers:
    """Checks the numbers in statements; `value` is None for those already reported."""

    findings: Findings
    evaluate: Evaluator
    sites: Sites

    def value(self, node: ast.Expression | None) -> float | None:
        """The value of an expression of constants; None without an expression or after a reported error in it."""
        return None if node is None or not self.sites.complete(node) else self.evaluate(node)

    def check(self, items: Iterable[Item]) -> None:
        """Checks that ranges are ordered and contain starting values and defaults, and checks noise and priors."""
        for item in items:
            match item.statement:
                case (
                    ast.StateStatement(range=interval, start=start)
                    | ast.AlgebraicStatement(range=interval, start=start)
                ):
                    self._in_range(interval, start, "the start")
                case ast.ConditionStatement(range=interval, default=default):
                    self._in_range(interval, default, "the default")
                case ast.InputStatement(range=interval, default=default) as statement:
                    self._in_range(interval, default, "the default")
                    if statement.interpolation is None:
                        self._interpolation(statement)
                case ast.LearnStatement() as statement:
                    self._learnable(statement)
                case ast.ObserveStatement(noise=noise):
                    if noise is not None and noise.kind.text not in WITH_DENSITY:  # by `noises`
                        self._distribution(noise, "noise", 1, "the standard deviation", "the coefficient of variation")
                case ast.UnknownStatement(arguments=arguments):
                    for argument in arguments:
                        self.interval(argument.range)
                case ast.Remark() | ast.Formula() | ast.TimeStatement() | ast.DoseStatement():
                    pass
                case _:
                    assert_never(item.statement)

    def interval(self, interval: ast.Interval | None) -> tuple[float, float] | None:
        """The ends of a range; an error if they are not in order."""
        if interval is None:
            return None
        low, high = self.value(interval.low), self.value(interval.high)
        if low is None or high is None:
            return None
        if low >= high:
            equal = low == high
            self.findings.error(
                "GB225",
                "the range is empty: its ends are equal" if equal else f"the range runs from {low:g} down to {high:g}",
                interval.span,
                help=""
                if equal
                else f"write the smaller end first: `in [{interval.high.span.text}, {interval.low.span.text}]`",
            )
            return None
        return low, high

    def _in_range(self, interval: ast.Interval | None, start: ast.Expression | None, what: str) -> None:
        ends, value = self.interval(interval), self.value(start)
        if ends is None or value is None or interval is None or start is None or ends[0] <= value <= ends[1]:
            return
        self.findings.error(
            "GB222",
            f"{what} {value:g} lies outside the range from {ends[0]:g} to {ends[1]:g}",
            start.span,
            labels=[Label(interval.span, "the range")],
            help="widen the range, or choose a value inside it",
        )

    def _interpolation(self, statement: ast.InputStatement) -> None:
        self.findings.error(
            "GB227",
            f"the input `{statement.name.text}` does not specify its interpolation between rows",
            statement.name.span,
            help=f"write `input {statement.name.text} held` (constant to the next filled cell) or "
            f"`input {statement.name.text} linear`",
        )

    # -------------------------------------------------------------------------------------------------- learnables

    def start(self, statement: ast.LearnStatement) -> float | None:
        """The starting value of a learnable: the given one, else the center of the prior; None without either."""
        given = self.value(statement.start)
        if given is not None or statement.prior is None:
            return given
        return self.value(statement.prior.arguments[0]) if statement.prior.arguments else None

    def bounds(self, statement: ast.LearnStatement) -> tuple[float, float] | None:
        """The intersection of the range and all bounds of a learnable (zero included for a lognormal prior).

        None if one of them was reported.
        """
        positive = statement.prior is not None and statement.prior.kind.text == "lognormal"
        low, high = 0.0 if positive else -math.inf, math.inf
        if statement.range is not None:
            ends = self.interval(statement.range)
            if ends is None:
                return None
            low, high = max(low, ends[0]), ends[1]
        for bound in statement.bounds:
            value = self.value(bound.value)
            if value is None:
                return None
            if bound.operator in (">", ">="):
                low = max(low, value)
            else:
                high = min(high, value)
        return low, high

    def _learnable(self, statement: ast.LearnStatement) -> None:
        if statement.prior is not None:
            self._distribution(statement.prior, "prior", 2, "the standard deviation", "the coefficient of variation")
        ends = self.bounds(statement)
        name = statement.name
        if ends is None:
            return
        low, high = ends
        if low >= high:
            self.findings.error(
                "GB225",
                f"no number lies between the bounds of `{name.text}`",
                _bounds_span(statement),
                label=f"above {low:g} and below {high:g}",
            )
        elif statement.start is None and statement.prior is None and not (math.isfinite(low) or math.isfinite(high)):
            row = re.match(r"learn\s+(\w+\s*\[[^\]]*\])", statement.span.text)  # reported once for all elements
            shown = row[1] if row else name.text
            self.findings.error(
                "GB226",
                f"`{shown}` has neither a starting value nor a bound from which to derive one",
                name.span,
                help=f"write `learn {shown} = 1` or `learn {shown} in [0, 10]` with sensible numbers",
            )
        else:
            self._start_in_bounds(statement, low, high)

    def _start_in_bounds(self, statement: ast.LearnStatement, low: float, high: float) -> None:
        value = self.value(statement.start)
        if value is None or statement.start is None:
            return
        strict = {b.operator: self.value(b.value) for b in statement.bounds if b.operator in "<>"}
        if low <= value <= high and value not in (strict.get(">"), strict.get("<")):
            return
        self.findings.error(
            "GB222",
            f"the starting value {value:g} of `{statement.name.text}` violates its bounds",
            statement.start.span,
            labels=[Label(_bounds_span(statement), "the bounds")],
            help="choose a starting value inside them",
        )

    def _distribution(self, distribution: ast.Distribution, what: str, count: int, *scales: str) -> None:
        kinds = ("normal", "lognormal")
        kind = distribution.kind.text
        if kind not in kinds:
            self.findings.error(
                "GB232",
                f"`{kind}` is not a {what}",
                distribution.kind.span,
                help=f"write `{what} normal(…)` or `{what} lognormal(…)`"
                + (" or `noise student(…, 5)`, or of counts `noise poisson`" if what == "noise" else ""),
            )
            return
        scale = scales[kinds.index(kind)]
        if len(distribution.arguments) != count:
            location = {"normal": "the mean and ", "lognormal": "the median and "}[kind] if count == 2 else ""
            self.findings.error(
                "GB232",
                f"`{what} {kind}` takes {count} number{'s' if count > 1 else ''}: {location}{scale}",
                distribution.span,
                help=f"write `{what} {kind}({'3, 0.5' if count == 2 else '0.1'})` with your numbers",
            )
            return
        values = [self.value(argument) for argument in distribution.arguments]
        positive: Sequence[tuple[int, str]] = [(count - 1, scale)]
        if kind == "lognormal" and count == 2:
            positive = [(0, "the median"), *positive]
        for position, name in positive:
            value = values[position]
            if value is not None and value <= 0:
                self.findings.error("GB232", f"{name} must be positive", distribution.arguments[position].span)


def _bounds_span(statement: ast.LearnStatement) -> Span:
    spans = [part.span for part in (statement.range, *statement.bounds) if part is not None]
    result = spans[0] if spans else statement.name.span
    for span in spans[1:]:
        result = result.to(span)
    return result


def default_start(low: float, high: float) -> float:
    """The default starting value of a learnable: the middle of its bounds, or of their logarithms if far apart.

    With a single bound b it is b plus or minus max(|b|, 1), on the feasible side: 1 for `> 0`.
    """
    if not math.isfinite(high):
        return low + max(1.0, abs(low))
    if not math.isfinite(low):
        return high - max(1.0, abs(high))
    if low > 0 and high / low >= GEOMETRIC_FROM:
        return math.sqrt(low) * math.sqrt(high)
    return low + (high - low) / 2
