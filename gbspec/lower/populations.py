"""Lowers populations: distributions of constants, effects, correlations, and noises that are learned."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations

from gbspec.ir import Distribution, Level, Noise, Spread
from gbspec.ir import model as ir
from gbspec.semantics import GROUPS, SUBJECT, Checked
from gbspec.syntax import ast

SPREAD = 0.3
"""The start of a spread that is learned and not named."""


def distribution(statement: ast.LearnStatement, checked: Checked) -> Distribution | None:
    """The distribution that a statement gives to its constant."""
    name, levels, kind = statement.name.text, [], ""
    between: tuple[str | None, float] = (None, 0.0)
    for grouping in statement.groupings:
        if grouping.spread is None:
            return None
        kind, column = grouping.spread.kind.text, grouping.column.value
        own = column in GROUPS
        found = _spread_of(grouping.spread, name if own else f"{name}_{column}", checked)
        if own:
            between = found
        else:
            levels.append(Level(column, *found))
    if not kind:
        return None
    return Distribution(_KINDS[kind], implied_name("median", name, checked), *between, tuple(levels))


def _spread_of(spread: ast.Distribution, name: str, checked: Checked) -> tuple[str | None, float]:
    """The name of a spread, or the number that it is."""
    if not spread.arguments:
        return implied_name("sd", name, checked), 1.0
    value = checked.numbers.value(spread.arguments[0])
    if value is not None:
        return None, value
    return next(iter(checked.numbers.sites[spread.arguments[0]].references.names)), 1.0


_KINDS: dict[str, Spread] = {"lognormal": "lognormal", "normal": "normal", "logitnormal": "logitnormal"}


def effect(statement: ast.EffectStatement, description: str) -> ir.Learnable:
    """A standard normal effect as a constant of each trajectory."""
    return ir.Learnable(
        statement.name.text,
        0.0,
        per_trajectory=True,
        distribution=_standard(statement.per.column.value),
        by_subject=statement.per.column.value == SUBJECT,
        description=description,
        span=statement.name.span,
    )


def _standard(column: str) -> Distribution:
    """The distribution of an effect between trajectories, or between the groups of a column."""
    if column in GROUPS:
        return Distribution("standard")
    return Distribution("standard", fixed=0.0, levels=(Level(column),))


def implied_name(word: str, name: str, checked: Checked) -> str:
    """The name of a parameter that no statement declares: no name of the model."""
    found = f"{word}_{name}"
    while found in checked.table:
        found += "_"
    return found


def completed(model: ir.Model, checked: Checked) -> ir.Model:
    """The model with all parameters that its populations and learned noises imply."""
    groups = [tuple(n.text for n in s.constants) for s in checked.all(ast.CorrelateStatement)]
    channels = model.channels
    noises: list[ir.Learnable] = []
    if model.distributed or (model.marginal and not model.diffusions):
        channels, noises = _with_noise(model, checked)
    known = {k.name for k in model.learnables}
    implied = [
        *_medians(model.distributed),
        *_spreads(model.distributed, known),
        *(_correlation(pair, checked) for group in groups for pair in combinations(group, 2)),
        *noises,
    ]
    model = replace(model, channels=channels, implied=tuple(implied), correlated=tuple(groups))
    return replace(model, conditions=(*model.conditions, *_columns(model)))


def _columns(model: ir.Model) -> Iterable[ir.Condition]:
    """The columns of groups that the model does not declare, as conditions of each trajectory."""
    known = {condition.name for condition in model.conditions}
    for learnable in model.distributed:
        for level in learnable.distribution.levels if learnable.distribution is not None else ():
            if level.column not in known:
                known.add(level.column)
                yield ir.Condition(
                    level.column, labels=True, description="a group of trajectories", span=learnable.span
                )


def _medians(distributed: Iterable[ir.Learnable]) -> list[ir.Learnable]:
    found = []
    for learnable in distributed:
        made = learnable.distribution
        if made is not None and made.median:
            found.append(replace(learnable, name=made.median, per_trajectory=False, distribution=None))
    return found


def _spreads(distributed: Iterable[ir.Learnable], known: set[str]) -> list[ir.Learnable]:
    found = []
    for learnable in distributed:
        made = learnable.distribution
        if made is None:
            continue
        for spread in (made.spread, *(level.spread for level in made.levels)):
            if spread is not None and spread not in known:
                start = SPREAD if made.kind != "normal" else SPREAD * (abs(learnable.start) or 1.0)
                unit = learnable.unit if made.kind == "normal" else None
                found.append(ir.Learnable(spread, start, ir.Range(0.0, math.inf), unit=unit, span=learnable.span))
    return found


def _correlation(pair: Sequence[str], checked: Checked) -> ir.Learnable:
    return ir.Learnable(implied_name("correlation", "_".join(pair), checked), 0.0, ir.Range(-1.0, 1.0))


def _with_noise(model: ir.Model, checked: Checked) -> tuple[tuple[ir.Channel, ...], list[ir.Learnable]]:
    """The channels, with a learned noise where none is stated, and these noises."""
    channels, noises = [], []
    for channel in model.channels:
        if channel.noise is None:
            name = implied_name("noise", channel.name, checked)
            noises.append(ir.Learnable(name, 1.0, ir.Range(0.0, math.inf), unit=channel.unit, span=channel.span))
            channel = replace(channel, noise=Noise("normal", math.nan, ir.symbol(name)))
        channels.append(channel)
    return tuple(channels), noises
