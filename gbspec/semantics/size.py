"""The size of expressions after function calls are expanded; expressions that become too large are refused."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gbspec.diagnostics import Findings
from gbspec.semantics.expressions import fold
from gbspec.semantics.graph import Graph
from gbspec.semantics.sites import Site
from gbspec.semantics.table import Table
from gbspec.syntax import Kind, ast

LARGEST = 200_000
"""The maximal number of operations of an expression with its functions expanded."""

DEEPEST = 200
"""The maximal nesting depth of an expression with its functions expanded."""


@dataclass(frozen=True)
class Extent:
    """The number of operations, the depth, and how often each formal argument occurs."""

    size: int
    depth: int
    formals: dict[str, int]


def check(sites: Iterable[Site], graph: Graph, table: Table, findings: Findings) -> None:
    """Reports expressions that expansion makes too large or too deep, and marks them so that none is lowered."""
    sites = [s for s in sites if s.references.complete]
    bodies = {s.owner: s for s in sites if s.owner is not None and table[s.owner].kind is Kind.FUNCTION}
    known: dict[str, Extent] = {}
    refused: set[str] = set()
    for name in graph.order:
        if name in bodies and name not in graph.broken:
            body = bodies[name]
            if not refused.isdisjoint(body.references.names):  # reported at its origin
                refused.add(name)
                body.references.complete = False
                continue
            known[name] = _extent(body, known, table)
            if known[name].size > LARGEST or known[name].depth > DEEPEST:
                _refuse(body, findings)
                refused.add(name)
    for site in sites:
        calls = any(table[name].kind is Kind.FUNCTION for name in site.references.names)
        if not refused.isdisjoint(site.references.names):
            site.references.complete = False
        elif calls and not (site.owner in known and table[site.owner].kind is Kind.FUNCTION):
            extent = _extent(site, known, table)
            if extent.size > LARGEST or extent.depth > DEEPEST:
                _refuse(site, findings)


def _refuse(site: Site, findings: Findings) -> None:
    site.references.complete = False
    findings.error(
        "GB236",
        "this expression becomes too large when its function calls are expanded",
        site.expression.span,
        help=f"at most {LARGEST} operations, {DEEPEST} deep; name repeated parts with `let`",
    )


def _extent(site: Site, known: dict[str, Extent], table: Table) -> Extent:
    def combine(node: ast.Expression, parts: list[Extent]) -> Extent:
        if isinstance(node, ast.Name):
            return Extent(1, 1, {node.text: 1} if node.text in site.formals else {})
        depth = 1 + max((p.depth for p in parts), default=0)
        weights = [1] * len(parts)
        size = 1
        if isinstance(node, ast.Call) and node.function.text in known:
            statement = table[node.function.text].statement
            body = known[node.function.text]
            if isinstance(statement, ast.FunctionStatement):
                weights = [body.formals.get(p.text, 0) for p in statement.parameters]
            size, depth = body.size, depth + body.depth
        formals: dict[str, int] = {}
        for weight, part in zip(weights, parts, strict=True):
            size += weight * part.size
            for name, count in part.formals.items():
                formals[name] = min(formals.get(name, 0) + weight * count, LARGEST + 1)
        return Extent(min(size, LARGEST + 1), depth, formals)

    return fold(site.expression, combine)
