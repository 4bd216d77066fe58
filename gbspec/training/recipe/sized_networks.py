"""Sizes of unknown functions that act on unmeasured states alone, before anything is fitted.

Where no state with a curve has the function in its balance, slopes tell nothing of it, and a guess by ranges may be
wrong by any factor: an epidemic of which only reports are counted ends at once, or has everyone ill in a day. From
there no derivative leads back. So factors of the guess and constants are drawn, and whole solutions compare the draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import sobol, spread_over_ranges
from gbspec.training.problem import Parameters
from gbspec.training.recipe.context import Context
from gbspec.training.starts import robust_loss

DRAWS, FEWEST = 256, 16
"""So many draws are compared, and at least so many with many data."""
WORK = 4e5
"""Sub-steps of all draws, about two seconds with the kernel."""
SLOWER = 30
"""The torch graph gets so many times fewer draws."""
LOW, HIGH = -1.5, 2.5
"""Decadic logarithms of the factors: guesses by slopes of zero are too small more often than too large."""
FOLLOWED = 0.25
"""Mean loss up to which nothing is drawn: whole solutions follow the data (R² above 0.5) with the guess already."""
CLEARLY = 0.8
"""Drawn constants are taken instead of the declared ones where they leave less than this of the loss."""


def sized_networks(
    context: Context, parameters: Parameters, theta: Array, unseen: Mapping[str, Mask]
) -> tuple[Parameters, Array]:
    """The layout with the best drawn sizes of the `unseen` outputs of networks, and the vector with the best drawn
    constants; both as they were if no draw has a solution."""
    first = robust_loss(context.engine(parameters, 0.0), theta)
    places = [(name, i) for name, mask in unseen.items() for i in np.flatnonzero(mask).tolist()]
    if not places or first <= FOLLOWED * int(context.problem().seen.sum()):
        return parameters, theta
    learnables, substeps = context.model.learnables, max(int(context.packed().steps.sum()), 1)
    work = WORK / (1 if context.choice.kernel is not None else SLOWER)
    count = int(np.clip(work / substeps, FEWEST, DRAWS))
    shares = sobol(count, len(places) + len(learnables), context.seed)
    drawn = spread_over_ranges(learnables, shares[:, len(places) :])
    found = [(first, parameters, theta)]
    declared = 1 + count // 2  # so many have the given constants; by parity, both halves would not fill the ranges
    for i in range(count):
        layout = _resized(parameters, places, 10 ** (LOW + (HIGH - LOW) * shares[i, : len(places)]))
        vector = theta if i + 1 < declared else parameters.vector(parameters.natural(theta), drawn[i])
        found.append((robust_loss(context.engine(layout, 0.0), vector), layout, vector))
    losses = np.array([loss for loss, _, _ in found])
    if not np.isfinite(losses).any():
        return parameters, theta
    given, best = int(np.argmin(losses[:declared])), int(np.argmin(losses))
    _, layout, vector = found[best if losses[best] < CLEARLY * losses[given] else given]
    return layout, vector


def _resized(parameters: Parameters, places: list[tuple[str, int]], factors: Array) -> Parameters:
    """The layout with outputs of networks by factors larger, whose sizes are uncertain by as much as they are large."""
    fixed = {name: value.copy() for name, value in parameters.fixed.items()}
    for (name, i), factor in zip(places, factors, strict=True):
        center, scale = fixed[f"network.{name}.output_center"], fixed[f"network.{name}.output_scale"]
        scale[i] = factor * max(scale[i], abs(center[i]))
        center[i] *= factor
    return replace(parameters, fixed=fixed)
