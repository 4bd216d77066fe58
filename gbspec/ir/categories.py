"""Values of conditions with categories: whole numbers from 0 on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Diagnostic
from gbspec.ir.model import Condition


def category_text(name: str) -> str:
    """The name of a category as it is written in a model: in quotes, if it is not a word."""
    return name if name.isidentifier() else f'"{name}"'


def whole(conditions: Sequence[Condition], values: Array) -> Array:
    """Values of conditions [..., n] within their ranges, those of categories and groups as whole numbers.

    Numbers of categories stay what they are; numbers that are drawn evenly from the range give each of them as often.
    """
    counts = np.array([len(condition.categories) for condition in conditions], dtype=np.float64)
    labels = np.array([condition.labels for condition in conditions], dtype=bool)
    if not (counts.any() or labels.any()):
        return values
    numbers = np.clip(np.floor(values * counts / np.maximum(counts - 1, 1)), 0, np.maximum(counts - 1, 0))
    return np.where(labels, np.rint(values), np.where(counts > 0, numbers, values))


def not_categories(conditions: Iterable[Condition], values: Mapping[str, Iterable[float]]) -> list[Diagnostic]:
    """Errors (GB383) for numbers that are given for a condition, by its name, and stand for none of its categories."""
    found = []
    for condition in conditions:
        count = len(condition.categories)
        wrong = [number for number in values.get(condition.name, ()) if count and number not in range(count)]
        if wrong:
            listed = ", ".join(f'{number} "{name}"' for number, name in enumerate(condition.categories))
            message = f"{wrong[0]:g} is the number of no category of `{condition.name}`"
            help = f"give a category by its number: {listed}"
            found.append(Diagnostic("GB383", message, None, help=help, subject=condition.name))
    return found
