"""Where the data support a learned function: a distance to the arguments it was trained with, not the box around them.

Arguments are scaled by the width of their trained range. The limit is the distance at which the data themselves lie
from each other: the one within which 95 % of the training arguments have one of another trajectory, but neither less
than a fiftieth of the diagonal of the box nor more than a tenth of it; and at least half the distance between two
successive ones of a trajectory, since its solution passes through the places between them.

Measured on three fits of `lotka_volterra` (12 trajectories, 5 % noise), at random points of the box extended by 15 %,
in units of the function's standard deviation over the data: the error that one point in twenty exceeds is 0.09 at less
than half the limit, 0.17 up to the limit, 0.44 up to twice, 1.3 up to four times and 2.3 up to eight times the limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.backends import network_arguments

if TYPE_CHECKING:
    from scipy.spatial import KDTree

    from gbspec.backends import GeneratedModule
    from gbspec.runs import Run, Support

SHARE = 0.95
"""The share of training arguments that have one of another trajectory within the limit."""
LEAST, MOST = 0.02, 0.10
"""Bounds of the limit, in diagonals of the box of the training arguments."""
GAP = 0.25
"""The most that half the distance between two successive arguments of a trajectory counts, in diagonals."""
NEIGHBOURS = 2
"""An argument has one successive to it on either side."""
EDGE = 0.01
"""The share of the arguments left out at either end when the width of their range is measured."""
REPLICATE = 1e-9
"""Arguments closer than this, in widths, are the same."""
LOOKED_AT = 400
"""Training arguments from which the limit is computed."""


@dataclass(frozen=True)
class Fence:
    """The training arguments [P, A] of one network, and the trajectory `owner` [P] of each."""

    points: Array
    owner: Array

    @cached_property
    def width(self) -> Array:
        """The width [A] of each argument's trained range; 1 where it does not vary (every other value is then far)."""
        low, high = np.quantile(self.points, [EDGE, 1 - EDGE], axis=0)
        flat = 1e-6 * np.maximum(np.abs(self.points).max(axis=0), 1e-300)
        return np.asarray(np.maximum(high - low, flat), dtype=np.float64)

    @cached_property
    def limit(self) -> float:
        """The distance, in widths, beyond which a function is extrapolated."""
        diagonal = float(np.sqrt(max(int(np.sum(np.ptp(self.points, axis=0) > 0.5 * self.width)), 1)))
        others, gap = self._spacing
        return max(float(np.clip(others, LEAST * diagonal, MOST * diagonal)), min(0.5 * gap, GAP * diagonal))

    @cached_property
    def _tree(self) -> KDTree:
        from scipy.spatial import KDTree

        return KDTree(self.points / self.width)

    @cached_property
    def _spacing(self) -> tuple[float, float]:
        """Distances that 95 % of the training arguments keep: from the nearest one of another trajectory (0 if there is
        no other), and from the second nearest of their own."""
        scaled = self.points / self.width
        chosen = np.unique(np.linspace(0, len(scaled) - 1, min(len(scaled), LOOKED_AT)).astype(int))
        distance = np.linalg.norm(scaled[chosen, None] - scaled[None], axis=2)
        same = self.owner[chosen][:, None] == self.owner[None]
        # Replicates, with the same arguments, do not tell how far apart the data are.
        others = np.where(same | (distance < REPLICATE), np.inf, distance).min(axis=1)
        own = np.sort(np.where(same, distance, np.inf), axis=1)[:, : NEIGHBOURS + 1]
        return _usual(others), _usual(own[:, -1])

    def distance(self, points: Array) -> Array:
        """The distances [Q] of points [Q, A] from the training arguments, in units of the limit."""
        finite = np.where(np.isfinite(points), points, 1e300)
        with np.errstate(over="ignore"):
            return np.asarray(self._tree.query(finite / self.width)[0] / self.limit, dtype=np.float64)

    def beyond(self, points: Array) -> Mask:
        """Whether each of the points [Q, A] is extrapolated [Q]."""
        return np.asarray(self.distance(points) > 1.0, dtype=np.bool_)


def _usual(distances: Array) -> float:
    """The distance that a `SHARE` of the finite ones do not exceed; 0 if there is none."""
    finite = distances[np.isfinite(distances)]
    return float(np.quantile(finite, SHARE)) if len(finite) else 0.0


def fence_of(support: Support | None) -> Fence | None:
    """The fence of a network; None where it is not known with which arguments it was trained."""
    return None if support is None or not len(support.points) else Fence(support.points, support.owner)


@dataclass(frozen=True)
class Extrapolation:
    """Which functions of a member are extrapolated at a point of its state space; see `Fence`."""

    member: GeneratedModule
    fences: Mapping[str, Fence]

    def functions(
        self, t: float | Array, states: Array, condition: Array, inputs: Array, constants: Array
    ) -> dict[str, Mask]:
        """For each unknown whether it is extrapolated at R points [R]: times ([R] or one), states [R, n]; conditions,
        inputs and constants [R, m], or [m] for all."""
        count = len(states)
        rows = [np.broadcast_to(each, (count, np.shape(each)[-1])) for each in (condition, inputs, constants)]
        calls = network_arguments(self.member, np.broadcast_to(t, count), states, *rows)
        found: dict[str, Mask] = {}
        for network, each in zip(self.member.networks, calls, strict=True):
            fence = self.fences.get(network["name"])
            if fence is not None:
                far = [fence.beyond(points) for points in each]
                beyond: Mask = np.any([*far, np.zeros(count, dtype=bool)], axis=0)
                index = list(self.member.networks).index(network)
                names = [name for name, one in self.member.equations.unknowns.items() if one[0] == index]
                for name in names:
                    found[name] = beyond
        return found


def extrapolation_of(run: Run, number: int | None = None) -> Extrapolation | None:
    """Where the functions of a member (default: the first) are extrapolated; None if that is not known."""
    number = run.numbers[0] if number is None else number
    found = fences(run, number)
    return Extrapolation(run.member(number), found) if found else None


def fences(run: Run, number: int | None = None) -> dict[str, Fence]:
    """The fence of each network of a member (default: the first) by the network's name."""
    known = run.certainties(run.numbers[0] if number is None else number).support
    found = {name: fence_of(one) for name, one in known.items()}
    return {name: one for name, one in found.items() if one is not None}
