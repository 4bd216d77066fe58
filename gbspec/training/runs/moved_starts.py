"""Learned starts that lie far from the measured first values.

First values of noisy data count as measurements, so that a fit may move its starts away from them. Where they are known
to the user, as nominal concentrations are, other constants move too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from gbspec.arrays import Array, Mask
from gbspec.ir import LEAST_PREDICTED, Channel, ErrorScale, Model
from gbspec.training.problem import Integers, Problem
from gbspec.training.recipe import CLEAN

UNLIKELY = 1e-3
"""The probability below which differences between starts and first values are no errors of measurement."""
ANOTHER = 10.0
"""Starts that are smaller by this factor than first values that exceed the noise are no measurements of them."""


@dataclass(frozen=True)
class _Starts:
    """Learned starts [m] and measured first values [m] of a state in the trajectories `owner` [m]; `off` [m] is their
    difference in standard deviations of the noise, which is `noise` [m] in the unit of the state."""

    owner: Integers
    learned: Array
    measured: Array
    off: Array
    noise: Array

    @property
    def beyond_noise(self) -> bool:
        """Whether the differences are larger than the noise allows."""
        return bool(chdtrc(len(self.off), np.sum(self.off**2)) < UNLIKELY)

    @property
    def elsewhere(self) -> Mask:
        """The starts [m] that are another order of magnitude than first values which exceed the noise."""
        smaller = np.sign(self.measured) * self.learned * ANOTHER < np.abs(self.measured)
        return np.asarray(smaller & (np.abs(self.measured) > self.noise), dtype=np.bool_)


def moved_starts(model: Model, problem: Problem, initial: Array, noise: Mapping[str, float]) -> list[str]:
    """A sentence for each state whose learned starts `initial` [N, n] are far from its measured first values.

    `noise` has the standard deviations of the channels, those of logarithms for log-normal ones.
    """
    found = []
    for j, channel in enumerate(model.channels):
        if channel.state is None or model.states[channel.state].initial.kind != "measured":
            continue
        starts = _starts(problem, initial, j, channel.state, noise[channel.name])
        if starts is None:
            continue
        state = model.states[channel.state].name
        if not starts.measured.any() and np.mean(starts.off**2) > 1:
            found.append(_known_zero(channel, state, problem, starts))
        elif starts.elsewhere.any() or starts.beyond_noise:
            found.append(_moved(channel, state, problem, starts))
    return found


def _starts(problem: Problem, initial: Array, channel: int, state: int, deviation: float) -> _Starts | None:
    """The starts that have a measured first value; None without any, or where the noise is not known."""
    packed = problem.packed
    begins = packed.row_time == packed.start[packed.row_trajectory]
    rows = np.flatnonzero(problem.valued[:, channel] & (packed.row_index == 0) & begins)
    owner, measured = packed.row_trajectory[rows], packed.values[rows, channel]
    learned, log = initial[owner, state], bool(problem.scaling.log[channel])
    unit = np.maximum(np.abs(measured), np.finfo(np.float64).tiny) if log else np.ones(len(rows))
    own = packed.sd[rows, channel] / unit
    values = packed.values[problem.valued[:, channel], channel]
    scale = ErrorScale(log)
    least = CLEAN * float(np.nanstd(scale.measured(values)))
    noise = np.maximum(np.where(np.isfinite(own), own, deviation / packed.weights[rows, channel]), least)
    difference = scale.predicted(learned, LEAST_PREDICTED) - scale.measured(measured)
    known = np.isfinite(difference) & (noise > 0)
    if not known.any():
        return None
    found = owner, learned, measured, difference / np.where(known, noise, 1.0), noise * unit
    return _Starts(*(part[known] for part in found))


def _known_zero(channel: Channel, state: str, problem: Problem, starts: _Starts) -> str:
    worst = int(np.argmax(np.abs(starts.off)))
    everywhere = f" in all {len(starts.owner)} trajectories" if len(starts.owner) > 1 else ""
    return (
        f"the first value of `{channel.name}` is 0{everywhere}, and the fit starts at up to "
        f"{starts.learned[worst]:.3g}{_where(problem, starts, worst)}: first values count as measurements, with the "
        f"noise of all others. If it is known to be 0, write `initial {state} = 0`"
    )


def _moved(channel: Channel, state: str, problem: Problem, starts: _Starts) -> str:
    far = np.abs(starts.off) + np.where(starts.elsewhere, np.abs(starts.off).max() + 1, 0.0)
    worst = int(np.argmax(far))
    size = abs(float(starts.off[worst]))
    return (
        f"the fit starts `{state}` at {starts.learned[worst]:.3g}{_where(problem, starts, worst)}, where "
        f"{starts.measured[worst]:.3g} was measured ({size:.2g} standard deviations of the noise): first values count "
        "as measurements, and the model lacks something, or follows a solution that is not meant. If first values are "
        f"known, let a column have them (`condition {state}_0` and `initial {state} = {state}_0`)"
    )


def _where(problem: Problem, starts: _Starts, worst: int) -> str:
    labels = problem.packed.labels
    return f" in trajectory `{labels[int(starts.owner[worst])]}`" if len(labels) > 1 else ""
