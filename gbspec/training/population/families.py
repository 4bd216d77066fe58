"""The noises with a density of their own, by kind, and those of the values of a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Mask
from gbspec.ir import Model, NoiseKind
from gbspec.training.population.counts import NegativeBinomial, Poisson
from gbspec.training.population.family import Family, Rows
from gbspec.training.population.student import Student
from gbspec.training.problem import Integers

FAMILIES: Mapping[NoiseKind, Family] = {
    "student": Student(),
    "poisson": Poisson(),
    "negative_binomial": NegativeBinomial(),
}
"""All of them; `gbspec.ir.NOISES` says how they are written."""


class Families:
    """The families of measured values with the channels `channel` [m], each with its rows."""

    def __init__(self, model: Model, channel: Integers) -> None:
        kinds = [None if c.noise is None or c.noise.kind not in FAMILIES else c.noise.kind for c in model.channels]
        found: list[tuple[Family, Tensor]] = []
        self.mask: Mask = np.zeros(len(channel), dtype=np.bool_)
        for kind, family in FAMILIES.items():
            rows = np.flatnonzero(np.isin(channel, [i for i, one in enumerate(kinds) if one == kind]))
            self.mask[rows] = True
            if len(rows):
                found.append((family, torch.from_numpy(rows)))
        self.each = tuple(found)

    def __bool__(self) -> bool:
        """Whether any value has such a noise."""
        return bool(self.each)

    def put(self, terms: Tensor, of: Rows, made: Callable[[Family, Rows], Tensor]) -> Tensor:
        """The terms [m], with what is made of the values of each family in their places."""
        for family, rows in self.each:
            terms = terms.index_copy(0, rows, made(family, of.at(rows)))
        return terms
