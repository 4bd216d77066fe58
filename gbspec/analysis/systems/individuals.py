"""Constants of single trajectories from their distribution: drawn at random, or at given standard normal numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
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
class Individuals:
    """The distributed constants: their places among all constants, how each is distributed, and the factor B [q, q] of
    the covariance B B^T of their deviations."""

    learnables: tuple[Learnable, ...]
    place: tuple[int, ...]
    factor: Array

    @property
    def grouped(self) -> bool:
        """Whether groups of trajectories share a part of the deviations; the factor has it as if it were their own."""
        return any(k.distribution is not None and k.distribution.levels for k in self.learnables)

    @classmethod
    def of_model(cls, model: Model, names: Sequence[str]) -> Individuals | None:
        """Those of a model at its truth, else its starts; correlations are zero. None without distributed constants."""
        known = {k.name: k.start for k in (*model.learnables, *model.implied)}
        known |= {t.name: t.value for t in model.truth_constants}
        made = [k.distribution for k in model.distributed if k.distribution is not None]
        each = [[fixed if name is None else known[name] for name, fixed in m.spreads] for m in made]
        return cls._at(model, names, np.diag([float(np.linalg.norm(one)) for one in each])) if made else None

    @classmethod
    def of_member(cls, member: GeneratedModule, model: Model) -> Individuals | None:
        """Those that a fit has found; None where it has none."""
        found = member.info.get("population")
        if not isinstance(found, Mapping):
            return None
        names = [k.name for k in model.distributed]
        factor = np.array(found.get("factor"), dtype=np.float64)
        if found.get("names") != names or factor.shape != (len(names),) * 2:
            return None
        return cls._at(model, member.constants, factor)

    @classmethod
    def _at(cls, model: Model, names: Sequence[str], factor: Array) -> Individuals:
        places = tuple(list(names).index(k.name) for k in model.distributed)
        return cls(model.distributed, places, factor)

    def constants(self, typical: Array, z: Array) -> Array:
        """The constants of a trajectory with the standard normal numbers z [q]; `typical` has the medians."""
        out, deviation = np.array(typical, dtype=np.float64), self.factor @ z
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

    def drawn(self, solver: Solver, random: np.random.Generator) -> Solver:
        """A solver with the constants of a trajectory drawn at random in place of the medians."""
        own = copy(solver)
        own.constants = self.constants(solver.constants, random.standard_normal(len(self.place)))
        return own
