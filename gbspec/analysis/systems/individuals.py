"""Constants of single trajectories from their distribution: drawn at random, or at given standard normal numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.ir import Learnable, Model


class Constant(Protocol):
    """What has constants."""

    constants: Array


Solver = TypeVar("Solver", bound=Constant)


@dataclass(frozen=True)
class Shared:
    """A deviation that all trajectories with the same value in a column share: of which constant, its column and its
    standard deviation."""

    place: int
    column: str
    sd: float


@dataclass(frozen=True)
class Group:
    """What a fit has learned of one group: the deviations [m] of the distributed constants at `places`, their
    covariance [m, m], and their derivatives [m, K] by all constants."""

    places: tuple[int, ...]
    mean: Array
    covariance: Array
    slopes: Array


@dataclass(frozen=True)
class Individuals:
    """The distributed constants: their places among all constants, how each is distributed, and the mean [q] and the
    factor B [q, q] of the covariance B B^T of their deviations. `slopes` [q, K]: the derivatives of the mean by all
    constants. `learned` are groups of the training data, by column and value."""

    learnables: tuple[Learnable, ...]
    place: tuple[int, ...]
    factor: Array
    own: Array
    """The factor [q, q] of the deviations that trajectories do not share; without groups it is `factor`."""
    shared: tuple[Shared, ...] = ()
    learned: Mapping[tuple[str, float], Group] = field(default_factory=dict)
    mean: Array | float = 0.0
    slopes: Array | None = None

    @classmethod
    def of_model(cls, model: Model, names: Sequence[str]) -> Individuals | None:
        """Those of a model at its truth, else its starts; correlations are zero. None without distributed constants."""
        known = {k.name: k.start for k in (*model.learnables, *model.implied)}
        known |= {t.name: t.value for t in model.truth_constants}
        made = [k.distribution for k in model.distributed if k.distribution is not None]
        if not made:
            return None
        each = [[fixed if name is None else known[name] for name, fixed in m.spreads] for m in made]
        shared = tuple(
            Shared(k, level.column, sd)
            for k, (one, sds) in enumerate(zip(made, each, strict=True))
            for level, sd in zip(one.levels, sds[1:], strict=True)
        )
        factor, own = np.diag([float(np.linalg.norm(one)) for one in each]), np.diag([float(one[0]) for one in each])
        return cls._at(model, names, factor, own, shared)

    @classmethod
    def of_member(cls, member: GeneratedModule, model: Model) -> Individuals | None:
        """Those that a fit has found; None where it has none."""
        found = member.info.get("population")
        if not isinstance(found, Mapping):
            return None
        names = [k.name for k in model.distributed]
        factor = np.array(found.get("factor"), dtype=np.float64)
        own = np.array(found.get("own", found.get("factor")), dtype=np.float64)
        if found.get("names") != names or factor.shape != (len(names),) * 2 or own.shape != factor.shape:
            return None
        shared = tuple(Shared(int(k), str(column), float(sd)) for k, column, sd in found.get("groups", ()))
        return replace(cls._at(model, member.constants, factor, own, shared), learned=_learned(found, member.constants))

    @classmethod
    def _at(
        cls, model: Model, names: Sequence[str], factor: Array, own: Array, shared: tuple[Shared, ...]
    ) -> Individuals:
        places = tuple(list(names).index(k.name) for k in model.distributed)
        return cls(model.distributed, places, factor, own, shared)

    def of_groups(self, values: Mapping[str, float]) -> Individuals:
        """The distribution for a further trajectory with these values of conditions: the deviations of groups that were
        in the training data are those that were learned there, with their uncertainty."""
        known = {
            column: self.learned[column, values[column]]
            for column in dict.fromkeys(one.column for one in self.shared)
            if (column, values[column]) in self.learned
        }
        if not known:
            return self
        mean, covariance = np.zeros(len(self.place)), self.own @ self.own.T
        slopes = np.zeros((len(self.place), next(iter(known.values())).slopes.shape[1]))
        for one in self.shared:
            covariance[one.place, one.place] += 0.0 if one.column in known else one.sd**2
        for group in known.values():
            places = list(group.places)
            mean[places] += group.mean
            slopes[places] += group.slopes
            covariance[np.ix_(places, places)] += group.covariance
        sizes, vectors = np.linalg.eigh(covariance)
        return replace(self, mean=mean, factor=vectors * np.sqrt(np.maximum(sizes, 0.0)), slopes=slopes)

    def root(self, constants: Array) -> Array:
        """A root [q, q] of the covariance of the distributed constants, linear around a trajectory's constants [K]."""
        return self._by_deviation(constants)[:, None] * self.factor

    def moved(self, constants: Array, change: Array) -> Array:
        """The constants [K] of a trajectory with the constants [K] where those that all trajectories share, and
        medians, change by `change` [K]: what groups were learned to have follows."""
        out = constants + change
        if self.slopes is not None:
            out[list(self.place)] += self._by_deviation(constants) * (self.slopes @ change)
        return out

    def constants(self, typical: Array, z: Array) -> Array:
        """The constants of a trajectory with the standard normal numbers z [q]; `typical` has the medians.

        Deviations of its groups are part of z, as of a trajectory whose groups are not known.
        """
        return self._with(typical, self.mean + self.factor @ z)

    def _by_deviation(self, constants: Array) -> Array:
        """The derivatives [q] of the distributed constants by their deviations, at a trajectory's constants [K]."""
        out = np.ones(len(self.place))
        for i, (learnable, place) in enumerate(zip(self.learnables, self.place, strict=True)):
            kind, value = learnable.distribution.kind if learnable.distribution else "normal", constants[place]
            if kind == "lognormal":
                out[i] = value
            elif kind == "logitnormal":
                low, high = learnable.range.low, learnable.range.high
                out[i] = (value - low) * (high - value) / (high - low)
        return out

    def _with(self, typical: Array, deviation: Array) -> Array:
        out = np.array(typical, dtype=np.float64)
        for learnable, place, eta in zip(self.learnables, self.place, deviation, strict=True):
            kind, median = learnable.distribution.kind if learnable.distribution else "normal", out[place]
            if kind == "lognormal":
                out[place] = median * np.exp(eta)
            elif kind == "logitnormal":
                low, width = learnable.range.low, learnable.range.high - learnable.range.low
                share = (median - low) / width
                out[place] = low + width / (1 + np.exp(-(np.log(share / (1 - share)) + eta)))
            else:
                out[place] = median + eta
        return out

    def drawn(self, solver: Solver, random: np.random.Generator, values: Mapping[str, float], seed: int = 0) -> Solver:
        """A solver with the constants of a trajectory drawn at random in place of the medians.

        `values` are those of its conditions: trajectories with the same value of a group's column share its deviation,
        which follows from `seed` and this value.
        """
        deviation = self.own @ random.standard_normal(len(self.place))
        for number, one in enumerate(self.shared):
            value = np.float64(values[one.column]).view(np.uint64)
            deviation[one.place] += one.sd * np.random.default_rng([seed, 4, number, int(value)]).standard_normal()
        own = copy(solver)
        own.constants = self._with(solver.constants, deviation)
        return own


def _learned(found: Mapping[str, object], names: Sequence[str]) -> dict[tuple[str, float], Group]:
    """The groups of a run's data; none in runs that do not keep them."""
    kept, out = found.get("learned"), dict[tuple[str, float], Group]()
    if not isinstance(kept, Mapping):
        return out
    at = [list(names).index(name) for name in kept["constants"]]
    for column, value, places, mean, covariance, by in kept["of"]:
        slopes = np.zeros((len(mean), len(names)))
        slopes[:, at] = by
        out[str(column), float(value)] = Group(
            tuple(int(k) for k in places), np.array(mean), np.array(covariance), slopes
        )
    return out
