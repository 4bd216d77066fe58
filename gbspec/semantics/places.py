"""Reports names in places where they are not allowed, directly or through a `let` or a function used there."""

from __future__ import annotations

from collections.abc import Iterable

from gbspec.diagnostics import Findings, Label
from gbspec.semantics.graph import NODES, Graph
from gbspec.semantics.sites import Site
from gbspec.semantics.table import Table
from gbspec.syntax import ANY, Kind


def enforce(sites: Iterable[Site], table: Table, graph: Graph, findings: Findings) -> None:
    """Reports, for each expression, the first name that is not allowed in it, directly or through others."""
    for site in sites:
        if site.rule is not ANY and site.references.complete:
            _enforce(site, table, graph, findings)


def _enforce(site: Site, table: Table, graph: Graph, findings: Findings) -> None:
    rule = site.rule
    for state, span in site.references.nets.items():
        if Kind.PROCESS not in rule.allowed:
            site.references.complete = False
            findings.error(
                rule.code, f"`net({state})` is not allowed in {rule.place}", span, help=f"use only {rule.meant} there"
            )
            return
    for name, span in site.references.names.items():
        kind = table[name].kind
        why = f", which is {kind.value}" if kind not in rule.allowed else ""
        if not why and kind in NODES and name not in graph.broken:
            admitted = rule.allowed - rule.refused_within
            leaf = next(((k, n) for k, n in graph.leaves[name].items() if k not in admitted), None)
            why = f": it depends on `{leaf[1]}`, which is {leaf[0].value}" if leaf else ""
        if why:
            site.references.complete = False
            at = table[name].span
            findings.error(
                rule.code,
                f"{rule.place} cannot use `{name}`{why}",
                span,
                labels=[Label(at, "declared here")] if at is not None else [],
                help=f"use only {rule.meant} there",
            )
            return
