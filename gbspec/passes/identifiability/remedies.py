"""What can be written so that constants are told apart: values, priors, and one of several categories fixed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import sympy

from gbspec.ir import Condition, Intermediate, Learnable, Model


@dataclass(frozen=True)
class Differing:
    """A constant with a value for each category of a condition: the `let` that chooses, and what it chooses from."""

    chosen: Intermediate
    condition: Condition
    members: tuple[Learnable, ...]


def ways(model: Model, names: Sequence[str]) -> list[str]:
    """What can be done about one of the constants with these names."""
    learned = [k for k in model.learnables if k.name in names]
    groups = [group for group in differing(model) if any(k in group.members for k in learned)]
    inside = {k.name for group in groups for k in group.members}
    medians = [k.name for k in learned if k.distribution is not None]
    plain = [name for name in names if name not in inside and name not in medians]
    found = [f"give {_list(plain)} a value (`const`) or a prior"] if plain else []
    if medians:
        found.append(f"give the median of {_list(medians)} a prior (`prior` before `per`)")
    for group in groups:
        name, condition = group.chosen.name, group.condition.name
        lines = _fixed(group)
        found.append(f"give `{name}` a prior (`prior` before `per {condition}`)")
        found.append(f"fix that of one category: in place of `learn {name} … per {condition}` write {lines}")
    return found


def differing(model: Model) -> list[Differing]:
    """The constants that were declared with `per CONDITION`, without a distribution."""
    found: list[Differing] = []
    learned = {k.symbol: k for k in model.learnables}
    categories = {c.symbol: c for c in model.conditions if c.categories}
    for one in model.intermediates:
        symbols = one.value.free_symbols
        conditions = [categories[s] for s in symbols if s in categories]
        members = tuple(k for s, k in learned.items() if s in symbols)
        if one.kind != "let" or len(conditions) != 1 or len(members) + 1 != len(symbols) or not members:
            continue
        places = {k.span for k in members}  # they come from one statement
        if isinstance(one.value, sympy.Piecewise) and len(places) == 1 and one.span in places:
            found.append(Differing(one, conditions[0], members))
    return found


def _fixed(group: Differing) -> str:
    """The lines that fix the constant of the first category."""
    first, *others = group.members
    chosen = group.members[-1].name
    for category, member in list(zip(group.condition.categories, group.members, strict=False))[-2::-1]:
        name = category if category.isidentifier() else f'"{category}"'
        chosen = f"if({group.condition.name} == {name}, {member.name}, {chosen})"
    lines = [f"const {first.name}{_unit(first)} = {first.start:g}"]
    lines += [f"learn {k.name}{_unit(k)} = {k.start:g}{_bounds(k)}" for k in others]
    return _list([*lines, f"let {group.chosen.name} = {chosen}"], "and")


def _unit(learned: Learnable) -> str:
    return f" : {learned.unit}" if learned.unit else ""


def _bounds(learned: Learnable) -> str:
    low, high = learned.range.low, learned.range.high
    if math.isfinite(low) and math.isfinite(high):
        return f" in [{low:g}, {high:g}]"
    return f" > {low:g}" if math.isfinite(low) else ""


def _list(names: Sequence[str], word: str = "or") -> str:
    quoted = [f"`{name}`" for name in names]
    return quoted[0] if len(quoted) == 1 else ", ".join(quoted[:-1]) + f" {word} {quoted[-1]}"
