"""Runs the semantic checks, in an order in which each can rely on the earlier ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from gbspec.diagnostics import Findings, UserError
from gbspec.semantics import (
    allow,
    arrays,
    balances,
    categories,
    columns,
    conversions,
    doubts,
    events,
    graph,
    measured_rates,
    noises,
    own_values,
    places,
    populations,
    processes,
    size,
    table,
    tables,
    truths,
    unknowns,
    usage,
)
from gbspec.semantics.checked import Checked
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.merge import Item, Load, Merged, merge, names_a_unit
from gbspec.semantics.numbers import Numbers, constants, default_start, functions_of
from gbspec.semantics.scope import Resolver
from gbspec.semantics.sites import Sites
from gbspec.semantics.table import Table
from gbspec.syntax import MOST_STATEMENTS, Kind, ast, refused

Terms = dict[str, tuple[tuple[bool, processes.Term], ...]]


def check(file: ast.File, findings: Findings, load: Load) -> Checked | None:
    """Checks a parsed file, with the files it extends, and records everything wrong with it.

    Args:
        file: the syntax tree. If statements are missing from it (they had syntax errors), nothing is reported that
            their absence could explain.
        findings: where to record errors and warnings; warnings that the file accepts by `allow` are left out.
        load: reads a file that is extended; may raise `OSError`, `UnicodeDecodeError` or `UserError`.

    Returns:
        The checked model, or None if there is any error.
    """
    local = Findings()
    read = categories.expand(own_values.expand(merge(file, local, load), local), local)
    _limited(file, len(read.items))
    settled = conversions.occur(read.items)
    if settled:
        read = _converted(read, local)
    merged, found = arrays.expand(events.expand(read, local), local)
    merged = measured_rates.expand(merged, local)
    names = table.build(merged.items, local)
    accepted = allow.allowed(merged.items, names, local, merged)
    checked = _check(merged, names, accepted, local, settled=settled)
    if checked is not None:
        checked = dataclasses.replace(checked, source=read.items, arrays=found)
    told = dict.fromkeys(d for d in local if not allow.is_accepted(d, accepted))
    findings.extend(told)  # each once: a balance that a channel measures is checked in both places
    return None if findings.failed else checked


def _limited(file: ast.File, count: int) -> None:
    """Raises `UserError` if there are too many statements."""
    if count > MOST_STATEMENTS:
        what = f"this model has {count:,} statements; at most {MOST_STATEMENTS:,} are read"
        raise UserError([refused(file.span.source.path, what)])


def _check(
    merged: Merged, names: Table, accepted: allow.Allowed, findings: Findings, *, settled: bool
) -> Checked | None:
    items = merged.items
    places_of = Sites(items, names)
    resolver = Resolver(names, findings)
    for site in places_of:
        resolver.resolve(site)
    resolver.report_missing(merged)
    resolver.report_unapplied(merged)
    takers = _takers(places_of, names)
    rests = graph.build(places_of, names, takers, findings)
    places.enforce(places_of, names, rests, findings)
    size.check(places_of, rests, names, findings)
    values = constants(places_of, rests, names, findings)
    numbers = Numbers(findings, Evaluator(values, functions_of(names)), places_of)
    numbers.check(items)
    unknowns.check(items, numbers, findings)
    points = tables.check(items, findings)
    populations.check(items, names, numbers, findings, merged)
    noises.check(items, numbers, findings)
    terms = _terms(places_of, names, findings)
    balances.once(items, findings)
    balances.targets(items, names, findings, merged)
    balances.coverage(items, names, takers, places_of, rests, findings, merged)
    events.check(items, names, numbers, findings, merged)
    balances.start_cycles(items, places_of, names, findings)
    columns.check(items, names, findings)
    known = _truths(items, places_of, names, values, numbers, findings, merged)
    if not settled:
        _units(items, places_of, names, rests, terms, numbers.evaluate, findings)
    if findings.failed or merged.uncertain:
        return None
    if not usage.has_states(items, names, findings):
        return None
    observed = usage.observed_names(items)
    usage.unused(places_of, merged.in_indices | observed | populations.columns(items), names, findings)
    usage.only_compared(places_of, observed, names, findings, populations.without_cuts(items))
    order = tuple(n for n in rests.order if names[n].kind in (Kind.LET, Kind.PROCESS))
    subject = doubts.Subject(items, names, values, order, numbers, places_of)
    doubts.check(subject, findings)
    doubts.coefficients(terms, subject, findings)
    return Checked(items, names, order, values, numbers, terms, known, accepted, tables=points)


def _converted(read: Merged, findings: Findings) -> Merged:
    """The statements with quantities that are given in units as plain numbers and products.

    Units are checked here, on what was written; all else that is wrong is found in what is returned.
    """
    local = Findings()
    merged = measured_rates.expand(arrays.expand(events.expand(read, local), local)[0], local)
    names = table.build(merged.items, local)
    places_of = Sites(merged.items, names)
    resolver = Resolver(names, local)
    for site in places_of:
        resolver.resolve(site)
    rests = graph.build(places_of, names, _takers(places_of, names), local)
    evaluate = Evaluator(constants(places_of, rests, names, local), functions_of(names))
    terms = _terms(places_of, names, local)
    scales = _units(merged.items, places_of, names, rests, terms, evaluate, findings)
    usable = _usable(places_of, rests)
    for site in places_of:
        if not usable(site.expression):  # its units were not looked at, since it has another error
            scales.excuse(site.expression)
    return conversions.applied(read, scales, findings)


def _usable(places_of: Sites, rests: graph.Graph) -> Callable[[ast.Expression], bool]:
    """Whether an expression, and what it is computed from, has no error so far."""

    def usable(expression: ast.Expression) -> bool:
        return places_of.complete(expression) and rests.broken.isdisjoint(places_of[expression].references.names)

    return usable


def _units(
    items: tuple[Item, ...],
    places_of: Sites,
    names: Table,
    rests: graph.Graph,
    terms: Terms,
    evaluate: Evaluator,
    findings: Findings,
) -> conversions.Conversions:
    """Checks the units of all expressions without other errors; a model that names no unit does not import pint."""
    alone = not names_a_unit(items)
    clocks = [item.statement.unit for item in items if isinstance(item.statement, ast.TimeStatement)]
    if alone and not any(clocks):
        return conversions.Conversions()
    from gbspec.semantics import unit_rules

    if alone:
        unit_rules.check_alone([unit for unit in clocks if unit is not None], findings)
        return conversions.Conversions()

    usable = _usable(places_of, rests)
    return unit_rules.check(items, names, rests.order, terms, evaluate, usable, places_of, findings)


def _takers(places_of: Sites, names: Table) -> dict[str, list[str]]:
    """The processes in which each state takes part."""
    takers: dict[str, list[str]] = {}
    for site in places_of:
        if site.process is not None:
            for name in site.references.names:
                if names[name].kind is Kind.STATE and site.process not in takers.setdefault(name, []):
                    takers[name].append(site.process)
    return takers


def _terms(places_of: Sites, names: Table, findings: Findings) -> Terms:
    """The terms of every process, consumed and produced."""
    found: Terms = {}
    for site in places_of:
        if site.process is not None and site.references.complete:
            statement = names[site.process].statement
            consumed = isinstance(statement, ast.ProcessStatement) and statement.consumed is site.expression
            side = tuple((consumed, term) for term in processes.terms(site.expression, names, findings))
            found[site.process] = found.get(site.process, ()) + side
    return found


def _truths(
    items: tuple[Item, ...],
    places_of: Sites,
    names: Table,
    values: dict[str, float],
    numbers: Numbers,
    findings: Findings,
    merged: Merged,
) -> dict[str, float]:
    good = truths.check(items, names, findings, merged)
    starts: dict[str, float] = {}
    bounds: dict[str, tuple[float, float]] = {}
    for item in items:
        if isinstance(item.statement, ast.LearnStatement):
            statement = item.statement
            start, ends = numbers.value(statement.start), numbers.bounds(statement)
            if ends is not None:
                bounds[statement.name.text] = ends
                starts[statement.name.text] = start if start is not None else default_start(*ends)
    known = truths.values(good, places_of, names, values, starts, findings)
    for truth in good:
        name = truth.target.text
        if name in known and name in bounds and not bounds[name][0] <= known[name] <= bounds[name][1]:
            findings.warning(
                "GB405",
                f"the truth {known[name]:g} of `{name}` lies outside its bounds, so it cannot be learned",
                truth.value.span,
                help=f"widen the bounds of `{name}`, or accept it with `allow GB405 {name}`",
                subject=name,
            )
    return known
