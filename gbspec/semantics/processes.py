"""The sides of processes: sums of terms, each with one state and a coefficient."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.diagnostics import Findings, Span
from gbspec.semantics.expressions import ADDITIVE, chain, walk
from gbspec.semantics.table import Table
from gbspec.syntax import Kind, ast


@dataclass(frozen=True)
class Term:
    """One term of a side: a state and its coefficient, a product of factors (True: divided by)."""

    state: str
    negative: bool
    factors: tuple[tuple[bool, ast.Expression], ...]
    span: Span


def terms(side: ast.Expression, table: Table, findings: Findings) -> list[Term]:
    """The terms of a side, from left to right; a term without exactly one state is an error."""
    found: list[Term] = []
    stack: list[tuple[bool, ast.Expression]] = [(False, side)]
    while stack:
        negative, node = stack.pop()
        match node:
            case ast.Group(inner=inner):
                stack.append((negative, inner))
            case ast.Binary(operator=operator) if operator in ADDITIVE:
                stack.extend((negative != inverted, part) for inverted, part in reversed(chain(node)))
            case _:
                term = _term(node, negative, table, findings)
                if term is not None:
                    found.append(term)
    return found


def _term(node: ast.Expression, negative: bool, table: Table, findings: Findings) -> Term | None:
    states: list[ast.Name] = []
    factors: list[tuple[bool, ast.Expression]] = []
    stack: list[tuple[bool, ast.Expression]] = [(False, node)]
    while stack:
        inverted, part = stack.pop()
        match part:
            case ast.Group(inner=inner):
                stack.append((inverted, inner))
            case ast.Unary(operator=operator, operand=operand) if operator != "not":
                negative = negative != (operator == "-")
                stack.append((inverted, operand))
            case ast.Binary(operator="*" | "/"):
                stack.extend((inverted != below, factor) for below, factor in reversed(chain(part)))
            case ast.Name() if not inverted and _is_state(part, table):
                states.append(part)
            case _:
                factors.append((inverted, part))
    if len(states) == 1 and not any(_mentions_state(factor, table) for _, factor in factors):
        return Term(states[0].text, negative, tuple(factors), node.span)
    _report(node, states, findings)
    return None


def _is_state(node: ast.Expression, table: Table) -> bool:
    declaration = table.get(node.text) if isinstance(node, ast.Name) else None
    return declaration is not None and declaration.kind is Kind.STATE


def _mentions_state(node: ast.Expression, table: Table) -> bool:
    return any(_is_state(part, table) for part in walk(node))


def _report(node: ast.Expression, states: list[ast.Name], findings: Findings) -> None:
    if len(states) > 1:
        names = " and ".join(f"`{s.text}`" for s in states)
        message = f"this term of a process names {names}; a term has one state"
        help_ = "separate what is consumed or produced by `+`: `A + B -> C`; its rate law goes after `rate`"
    elif states:
        message = "the coefficient of this term of a process depends on a state"
        help_ = "the coefficients of a process are fixed: `2*A -> B`; dependence on states goes after `rate`"
    else:
        message = "this term of a process has no state"
        help_ = "each term is a state, or a number, constant or learnable constant times a state: `2*A`, `A/Y`"
    findings.error("GB305", message, node.span, help=help_)
