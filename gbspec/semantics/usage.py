"""Warnings on names without effect: never used, or used where they have no gradient."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gbspec.diagnostics import Findings, Label
from gbspec.semantics.merge import Item
from gbspec.semantics.sites import Site, Sites
from gbspec.semantics.table import Table
from gbspec.syntax import Kind, ast

_USELESS = {
    Kind.CONDITION: "the data would have to contain it for no purpose",
    Kind.INPUT: "the data would have to contain it for no purpose",
    Kind.CONST: "",
    Kind.LEARN: "nothing could be learned about it",
    Kind.LET: "",
    Kind.FUNCTION: "",
    Kind.TABLE: "",
    Kind.UNKNOWN: "nothing could be learned about it",
}


def unused(sites: Iterable[Site], elsewhere: Iterable[str], table: Table, findings: Findings) -> None:
    """Warns of each declared name that occurs neither in expressions nor in `elsewhere`.

    An occurrence of a learnable in a truth is not a use.
    """
    used = set(elsewhere)
    for site in sites:
        names = site.references.names
        used.update(
            n
            for n in names
            if n != site.owner and (site.counts or table[n].kind in (Kind.CONST, Kind.FUNCTION, Kind.TABLE, Kind.LET))
        )
    for declaration in table.values():
        if declaration.kind in _USELESS and declaration.name not in used and declaration.span is not None:
            why = _USELESS[declaration.kind]
            findings.warning(
                "GB403",
                f"`{declaration.name}` is declared and never used" + (f": {why}" if why else ""),
                declaration.span,
                help=f"delete it, use it, or accept it with `allow GB403 {declaration.name}`",
                subject=declaration.name,
            )


def observed_names(items: Iterable[Item]) -> set[str]:
    """The names that `observe NAME` measures directly."""
    return {
        item.statement.target.text
        for item in items
        if isinstance(item.statement, ast.ObserveStatement)
        and item.statement.value is None
        and isinstance(item.statement.target, ast.Name)
    }


_LEARNED: Mapping[str, str] = {
    "": "training learns it where a state, or the time, passes it, since steps end there then (not in models with "
    "delays, arrays, a search for algebraic variables or a steady start); a lag of doses is written `dose … lag {0}`; "
    "else let it enter smoothly",
    "disturbances": "beside `diffusion` the likelihood has no derivative by it, so that it stays at its start: let it "
    "enter smoothly",
}
"""What training makes of learnables that occur only where values jump, by `populations.without_cuts`."""


def only_compared(sites: Sites, observed: set[str], table: Table, findings: Findings, without_cuts: str) -> None:
    """Warns of learnables that occur only in conditions, `sign`, `floor` or `ceil`, whose gradient is zero but where
    steps end at the jumps (`without_cuts`: why they do not)."""
    values = {site.owner: site for site in sites if site.owner is not None}
    reached: dict[bool, set[str]] = {True: set(), False: set()}
    for smooth, found in reached.items():
        pending = list(observed)
        for site in sites:
            if site.counts and (site.owner is None or table[site.owner].kind is Kind.PROCESS):
                pending.extend(_named(site, smooth))
        while pending:
            name = pending.pop()
            if name not in found:
                found.add(name)
                if name in values:
                    pending.extend(_named(values[name], smooth))
    for declaration in table.values():
        name = declaration.name
        if declaration.kind is Kind.LEARN and name in reached[False] and name not in reached[True]:
            places = [s.references.names[name] for s in sites if s.counts and name in s.references.names]
            findings.warning(
                "GB404",
                f"`{name}` occurs only where values jump, so that only the times of jumps depend on it",
                declaration.span,
                labels=[Label(span, "in a comparison, or in a function that jumps") for span in places[:4]],
                help=_LEARNED[without_cuts].format(name)
                + f", for example by `1/(1 + exp(-(x - {name})/width))`, or make it a `const`",
                subject=name,
            )


def _named(site: Site, smooth: bool) -> Iterable[str]:
    return site.references.smooth if smooth else site.references.names


def has_states(items: Iterable[Item], table: Table, findings: Findings) -> bool:
    """Whether the model has states (else an error); without channels it cannot be trained (a warning)."""
    items = list(items)
    states = [d for d in table.values() if d.kind is Kind.STATE]
    model = next((i.statement for i in items if isinstance(i.statement, ast.ModelStatement)), None)
    place = model.name.span if model is not None else (items[0].statement.span if items else None)
    if not states:
        findings.error(
            "GB315",
            "the model has no state, so nothing in it changes over time",
            place,
            help="declare one with its balance: `state x` and `x' = …`",
        )
    elif not any(isinstance(i.statement, ast.ObserveStatement) for i in items):
        findings.warning(
            "GB406",
            "nothing is observed, so the model cannot be compared with data",
            place,
            help=f"add `observe {states[0].name}` for each state that is measured, or accept it with `allow GB406`",
        )
    return bool(states)
