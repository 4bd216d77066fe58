"""Values of conditions with categories: whole numbers from 0 on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.ir.model import Condition


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
