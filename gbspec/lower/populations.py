"""Lowers populations: distributions of constants, effects, correlations, and noises that are learned."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations

from gbspec.ir import Distribution, Noise, Spread
from gbspec.ir import model as ir
from gbspec.semantics import Checked
from gbspec.syntax import ast

SPREAD = 0.3
"""The start of a spread that is learned and not named."""


def distribution(statement: ast.LearnStatement, checked: Checked) -> Distribution | None:
    """The distribution that a statement gives to its constant."""
    spread = statement.per.spread if statement.per is not None else None
    if spread is None:
        return None
    name, kind = statement.name.text, _KINDS[spread.kind.text]
    median = implied_name("median", name, checked)
    if not spread.arguments:
        return Distribution(kind, median, implied_name("sd", name, checked))
    value = checked.numbers.value(spread.arguments[0])
    if value is not None:
        return Distribution(kind, median, None, value)
    return Distribution(kind, median, next(iter(checked.numbers.sites[spread.arguments[0]].references.names)))


_KINDS: dict[str, Spread] = {"lognormal": "lognormal", "normal": "normal", "logitnormal": "logitnormal"}


def effect(statement: ast.EffectStatement, description: str) -> ir.Learnable:
    """A standard normal effect as a constant of each trajectory."""
    return ir.Learnable(
        statement.name.text,
        0.0,
        per_trajectory=True,
        distribution=Distribution("standard"),
        description=description,
        span=statement.name.span,
    )


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
    if model.distributed:
        channels, noises = _with_noise(model, checked)
    known = {k.name for k in model.learnables}
    implied = [
        *_medians(model.distributed),
        *_spreads(model.distributed, known),
        *(_correlation(pair, checked) for group in groups for pair in combinations(group, 2)),
        *noises,
    ]
    return replace(model, channels=channels, implied=tuple(implied), correlated=tuple(groups))


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
        if made is not None and made.spread is not None and made.spread not in known:
            start = SPREAD if made.kind != "normal" else SPREAD * (abs(learnable.start) or 1.0)
            unit = learnable.unit if made.kind == "normal" else None
            found.append(ir.Learnable(made.spread, start, ir.Range(0.0, math.inf), unit=unit, span=learnable.span))
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
