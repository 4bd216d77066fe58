"""Learned noises of fits with disturbances that are smaller than measurements can have them.

The likelihood hardly tells a small noise from none where a disturbance acts on what is measured: it then follows every
value, and what single values determine, as a start does, seems to be known as well as the noise is small.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from decimal import Decimal

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Filtered, FilterEngine, filter

ROUNDED = 0.5
"""A noise below this part of that which rounding leaves is too small."""
HARDLY = 1e-2
"""So is one below this part of the standard deviation of the innovations."""
ENOUGH, MOST = 10, 1000
"""Values from which the step of a table is told, and how many of them are looked at."""


def step_of(values: Array) -> float:
    """The power of ten that all values are multiples of, as the table has them; 0 for few values, or none but zeros."""
    distinct = np.unique(values[np.isfinite(values) & (values != 0)])
    if len(values) < ENOUGH or not len(distinct):
        return 0.0
    looked = distinct[:: max(len(distinct) // MOST, 1)]
    exponents = [Decimal(repr(float(value))).normalize().as_tuple().exponent for value in looked]
    return float(10.0 ** min(e for e in exponents if isinstance(e, int)))


def said_of_small_noises(engine: FilterEngine, found: Filtered, vector: Array, names: Collection[str]) -> list[str]:
    """A sentence for each of these channels whose learned noise is far below the rounding of its values, or hardly any
    part of what predictions from row to row miss. (Noises that have gone to zero are told by themselves.)"""
    if not found.finite:
        return []
    out, packed = [], engine.problem.packed
    errors, ahead = filter.one_row_ahead(engine, found)
    _, log_sd = engine.layout.split(vector)
    for place, channel in enumerate(engine.noise.learned):
        name, seen = engine.problem.model.channels[channel].name, engine.problem.valued[:, channel]
        values, noise = packed.values[seen, channel], float(np.exp(log_sd[place]))
        counted = ahead[:, channel]
        missed = float(np.sqrt(np.mean(errors[counted, channel] ** 2))) if counted.any() else math.nan
        step = step_of(values)
        rounding = step / math.sqrt(12)
        if name in names and noise < ROUNDED * rounding:
            why = f"less than the rounding of its values to multiples of {step:g} leaves, {rounding:.2g}"
        elif name in names and noise < HARDLY * missed:
            why = f"less than a hundredth of what predictions from row to row miss, {missed:.2g}"
        else:
            continue
        out.append(
            f"the learned noise of `{name}` is {noise:.2g}, {why}: all that its "
            "values scatter is taken for a disturbance, and starts and constants that single values tell look too "
            "certain. State the noise of measurement: `noise normal(…)`"
        )
    return out
