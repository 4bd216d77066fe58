"""The dependency graph of constants, `let`s, functions and processes: cycles, an order of evaluation, dependencies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics.sites import Site
from gbspec.semantics.table import Table
from gbspec.syntax import Kind

NODES = frozenset({Kind.CONST, Kind.LET, Kind.FUNCTION, Kind.PROCESS})
"""The kinds whose values are given by expressions."""


@dataclass(frozen=True)
class Graph:
    """`order`: names, each after all it depends on. `leaves`: the names of other kinds that each depends on.

    `broken`: names whose value is unknown because of an error already reported.
    """

    order: tuple[str, ...]
    leaves: Mapping[str, Mapping[Kind, str]]
    nets: Mapping[str, frozenset[str]]
    broken: frozenset[str]


def edges_of(site: Site, table: Table, takers: Mapping[str, Iterable[str]]) -> dict[str, Span]:
    """The nodes that an expression depends on, and where it names them; `net(X)` names every process with `X`."""
    found: dict[str, Span] = {}
    for name, span in site.references.names.items():
        if table[name].kind in NODES:
            found.setdefault(name, span)
    for state, span in site.references.nets.items():
        for process in takers.get(state, ()):
            found.setdefault(process, span)
    return found


def build(sites: Iterable[Site], table: Table, takers: Mapping[str, Iterable[str]], findings: Findings) -> Graph:
    """The graph of all names with a value; every cycle is an error that names it in full.

    `takers` gives the processes in which a state takes part.
    """
    values: dict[str, Site] = {}
    for site in sites:
        if site.owner is not None:
            values.setdefault(site.owner, site)
    edges = {name: edges_of(site, table, takers) for name, site in values.items()}
    order, cycles = _sort({name: [n for n in found if n in edges] for name, found in edges.items()})
    broken = {name for name, site in values.items() if not site.references.complete}
    reported: set[str] = set()
    for cycle in cycles:
        if reported.isdisjoint(cycle):  # cycles that share a name are one error
            _report(cycle, edges, table, findings)
        reported.update(cycle)
    broken |= reported
    leaves: dict[str, dict[Kind, str]] = {}
    nets: dict[str, frozenset[str]] = {}
    for name in order:
        own: dict[Kind, str] = {}
        within: set[str] = set(values[name].references.nets)
        for other in values[name].references.names:
            if other in edges:
                for kind, leaf in leaves.get(other, {}).items():
                    own.setdefault(kind, leaf)
                within |= nets.get(other, frozenset())
            else:
                own.setdefault(table[other].kind, other)
        if values[name].references.nets:
            own.setdefault(Kind.PROCESS, next(iter(values[name].references.nets)))
        leaves[name], nets[name] = own, frozenset(within)
        if any(other in broken for other in edges[name]):
            broken.add(name)
    return Graph(tuple(order), leaves, nets, frozenset(broken))


def _sort(edges: Mapping[str, list[str]]) -> tuple[list[str], list[list[str]]]:
    """Names, each after what it depends on, and the cycles found (one per back edge)."""
    state = dict.fromkeys(edges, 0)  # 0 new, 1 on the current path, 2 done
    order: list[str] = []
    cycles: list[list[str]] = []
    for root in edges:
        if state[root]:
            continue
        path: list[str] = [root]
        pending = [iter(edges[root])]
        state[root] = 1
        while path:
            following = next(pending[-1], None)
            if following is None:
                pending.pop()
                done = path.pop()
                state[done] = 2
                order.append(done)
            elif state[following] == 0:
                state[following] = 1
                path.append(following)
                pending.append(iter(edges[following]))
            elif state[following] == 1:
                cycles.append(path[path.index(following) :])
    return order, cycles


def _report(cycle: list[str], edges: Mapping[str, Mapping[str, Span]], table: Table, findings: Findings) -> None:
    following = [*cycle[1:], cycle[0]]
    spans = [edges[name][after] for name, after in zip(cycle, following, strict=True)]
    first = min(range(len(cycle)), key=lambda i: (spans[i].source.path, spans[i].start))
    turned = [*cycle[first:], *cycle[:first]]
    places = [*spans[first:], *spans[:first]]
    shown = turned if len(turned) <= 12 else [*turned[:6], "…", *turned[-5:]]
    circle = " -> ".join(name if name == "…" else f"`{name}`" for name in [*shown, turned[0]])
    nexts = [*turned[1:], turned[0]]
    findings.error(
        "GB208",
        f"{table[turned[0]].kind.value.removeprefix('a ')} `{turned[0]}` depends on itself: {circle}",
        places[0],
        label=f"needs `{nexts[0]}`" if len(turned) > 1 else "needs itself",
        labels=[Label(s, f"needs `{n}`") for s, n in list(zip(places, nexts, strict=True))[1:8]],
        help="a value cannot depend on itself; break the cycle by writing one of them in terms of other names",
    )
