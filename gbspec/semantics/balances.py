"""Checks statements about states and channels: at most one balance, initial value and measurement per name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import assert_never

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics.graph import Graph
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.sites import Site, Sites
from gbspec.semantics.table import Declaration, Table
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import Key, Kind, ast, target_name

_TWICE = {
    "balance": ("GB302", "`{0}` has two balances", "add their right sides, or delete one of them"),
    "initial": ("GB202", "the initial value of `{0}` is given twice", "delete one of them"),
    "observe": ("GB202", "`{0}` is observed twice", "delete one of them, or give one another name: `observe y = …`"),
    "dose": ("GB202", "doses into `{0}` are declared twice", "delete one of them"),
    "diffusion": ("GB341", "`{0}` has two diffusions", "write one, for example the root of the sum of their squares"),
    "equation": ("GB202", "the equation `{0}` is written twice", "delete one of them, or give one another name"),
    "history": ("GB371", "the history of `{0}` is given twice", "delete one of them"),
    "truth": ("GB202", "the truth of `{0}` is given twice", "delete one of them"),
}

MEASURABLE = frozenset({Kind.STATE, Kind.LET, Kind.PROCESS, Kind.ALGEBRAIC})
"""The kinds that `observe NAME` can measure without an expression."""


def once(items: Iterable[Item], findings: Findings) -> None:
    """Reports each repeated statement of one kind about a name."""
    first: dict[Key, ast.About] = {}
    for statement in (item.statement for item in items):
        if not isinstance(statement, ast.About):
            continue
        for word, name in statement.replaces():
            earlier = first.setdefault((word, name), statement)
            if earlier is statement or _both_declare(earlier, statement):
                continue
            code, message, help_ = _TWICE[word]
            findings.error(
                code,
                message.format(name),
                statement.target.span,
                label="again",
                labels=[Label(earlier.target.span, "the first")],
                help=help_,
            )


def _both_declare(a: ast.About, b: ast.About) -> bool:
    """Whether both declare a name: then it is declared twice, which `table.build` reports."""
    channels = all(isinstance(s, ast.ObserveStatement) and s.value is not None for s in (a, b))
    return channels or isinstance(b, ast.EquationStatement)


def targets(items: Iterable[Item], table: Table, findings: Findings, merged: Merged) -> None:
    """Checks that balances, initial values and doses are for states, and that directly observed names can be."""
    for statement in (item.statement for item in items):
        if not isinstance(statement, ast.About):
            continue
        match statement:
            case ast.BalanceStatement(target=target):
                _state(target, table, findings, "GB303", "a balance is for a state", merged)
            case ast.InitialStatement(target=target):
                _state(target, table, findings, "GB309", "only a state has an initial value", merged)
            case ast.DoseStatement(target=target):
                _state(target, table, findings, "GB313", "a dose adds to a state", merged)
            case ast.DiffusionStatement(target=target):
                _state(target, table, findings, "GB342", "only a state has a diffusion", merged)
            case ast.HistoryStatement(target=target):
                _state(target, table, findings, "GB371", "only a state has a history", merged)
            case ast.ObserveStatement(target=target, value=value):
                if value is None and isinstance(target, ast.Name):
                    _measurable(target, table, findings, merged)
            case ast.TruthStatement() | ast.EquationStatement():
                pass  # see truths.py; an equation declares its name
            case _:
                assert_never(statement)


def _state(
    target: ast.Name | ast.Index, table: Table, findings: Findings, code: str, rule: str, merged: Merged
) -> None:
    name = target_name(target)
    declaration = table.get(name.text)
    if declaration is None:
        if merged.lacks(name.text):
            states = [n for n, d in table.items() if d.kind is Kind.STATE]
            findings.error(
                "GB201",
                f"no state is named `{name.text}`",
                name.span,
                label="not declared",
                help=suggestion(name.text, states) or f"declare it: `state {name.text}`",
                subject=name.text,
            )
    elif declaration.kind is not Kind.STATE:
        findings.error(
            code,
            f"`{name.text}` is {declaration.kind.value}, but {rule}",
            name.span,
            labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
            help=f"declare `state {name.text}` instead, or name a state here",
        )


def _measurable(target: ast.Name, table: Table, findings: Findings, merged: Merged) -> None:
    declaration = table.get(target.text)
    if declaration is None:
        if merged.lacks(target.text):
            pool = [n for n, d in table.items() if d.kind in MEASURABLE]
            findings.error(
                "GB201",
                f"undeclared name `{target.text}`",
                target.span,
                label="not declared",
                help=suggestion(target.text, pool) or f"say what is measured: `observe {target.text} = …`",
                subject=target.text,
            )
    elif declaration.kind not in MEASURABLE:
        findings.error(
            "GB312",
            f"`{target.text}` is {declaration.kind.value}, and cannot be observed without an expression",
            target.span,
            labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
            help=f"give the channel a name and an expression: `observe {target.text}_measured = …`",
        )


def coverage(
    items: Iterable[Item],
    table: Table,
    takers: Mapping[str, Iterable[str]],
    sites: Sites,
    graph: Graph,
    findings: Findings,
    merged: Merged,
) -> None:
    """Checks for states without balance or process, balances that omit `net`, and `net` without processes."""
    balanced: set[str] = set()
    for balance in (item.statement for item in items):
        if isinstance(balance, ast.BalanceStatement):
            name = target_name(balance.target).text
            balanced.add(name)
            site = sites[balance.value]
            if name in takers and site.references.complete and not _has_net(name, site, graph):
                _net_omitted(balance, name, takers[name], table, findings)
    bare = [d for d in table.values() if d.kind is Kind.STATE and d.name not in balanced and d.name not in takers]
    _no_balance([d for d in bare if merged.lacks(d.name)], findings)
    _empty_nets(sites, takers, findings, merged)


def _no_balance(states: Iterable[Declaration], findings: Findings) -> None:
    """Reports each statement that declares states without a balance, once for all elements of an array."""
    together: dict[Span | None, list[str]] = {}
    for declaration in states:
        together.setdefault(declaration.span, []).append(declaration.name)
    for span, names in together.items():
        array = span is not None and span.text != names[0]
        few = ", ".join(f"`{name}`" for name in names[:3]) + (", …" if len(names) > 3 else "")
        findings.error(
            "GB301",
            f"the state {few} has no balance" if len(names) == 1 else f"the states {few} have no balance",
            span,
            help=f"say how {'it changes' if len(names) == 1 else 'they change'}: "
            f"`{span.text + '[i]' if span is not None and array else names[0]}' = …`",
            subject=names[0],
        )


def _has_net(state: str, site: Site, graph: Graph) -> bool:
    references = site.references
    return state in references.nets or any(
        state in graph.nets.get(name, frozenset()) or name in graph.broken for name in references.names
    )


def _net_omitted(
    balance: ast.BalanceStatement, name: str, processes: Iterable[str], table: Table, findings: Findings
) -> None:
    places = [Label(span, "takes part here") for p in processes if (span := table[p].span) is not None]
    findings.warning(
        "GB307",
        f"the balance of `{name}` omits the processes that consume or produce `{name}`",
        balance.span,
        labels=places[:4],
        help=f"add `net({name})` to the right side, or accept it with `allow GB307 {name}`",
        subject=name,
    )


def _empty_nets(sites: Iterable[Site], takers: Mapping[str, Iterable[str]], findings: Findings, merged: Merged) -> None:
    for site in sites:
        for state, span in site.references.nets.items():
            if state not in takers and merged.lacks(state):
                findings.warning(
                    "GB314",
                    f"`net({state})` is zero, since no process consumes or produces `{state}`",
                    span,
                    help=f"name `{state}` in a process, delete `net({state})`, or accept it with `allow GB314 {state}`",
                    subject=state,
                )


def start_cycles(items: Iterable[Item], sites: Sites, table: Table, findings: Findings) -> None:
    """Reports initial values that depend on themselves through other states' initial values."""
    edges: dict[str, dict[str, Span]] = {}
    for start in (item.statement for item in items):
        if isinstance(start, ast.InitialStatement) and start.value is not None:
            site = sites[start.value]
            names = site.references.names if site.references.complete else {}
            states = {n: s for n, s in names.items() if table[n].kind is Kind.STATE}
            edges.setdefault(target_name(start.target).text, states)
    done: set[str] = set()
    for root in edges:
        path: list[str] = []
        stack = [(root, iter(edges[root]))]
        path.append(root)
        while stack:
            name, following = stack[-1]
            other = next((n for n in following if n in edges and n not in done), None)
            if other is None:
                stack.pop()
                done.add(path.pop())
            elif other in path:
                circle = [*path[path.index(other) :], other]
                findings.error(
                    "GB310",
                    "an initial value depends on itself: " + " -> ".join(f"`{n}`" for n in circle),
                    edges[name][other],
                    help="give one of them an independent initial value, or `initial X learn`",
                )
                done.update(path)
                break
            else:
                path.append(other)
                stack.append((other, iter(edges[other])))
