"""Random points at which an export is compared with the generated module."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.exports.subject import Exported
from gbspec.ir import Condition, Input, State, whole

SPREAD = 0.05
"""How far constants are varied, relative to their values."""


@dataclass(frozen=True)
class Points:
    """R points: times [R], states [R, n], conditions, inputs, constants [R, m], and a direction at each, likewise. With
    delays the delayed values stand behind the inputs."""

    t: Array
    x: Array
    condition: Array
    inputs: Array
    constants: Array
    along: tuple[Array, Array, Array, Array, Array]

    def __len__(self) -> int:
        return len(self.t)

    @property
    def arguments(self) -> tuple[Array, Array, Array, Array, Array]:
        """Times, states, conditions, inputs, constants."""
        return self.t, self.x, self.condition, self.inputs, self.constants


def draw(exported: Exported, count: int, seed: int = 0, spread: float = SPREAD) -> Points:
    """Points within the declared ranges, or around the values that are known, with constants near their own."""
    random, model = np.random.default_rng(seed), exported.model
    boxes = [
        _boxes(items, values)
        for items, values in (
            (model.states, exported.states),
            (model.conditions, exported.conditions),
            (model.inputs, exported.inputs),
        )
    ]
    drawn = [box[:, 0] + (box[:, 1] - box[:, 0]) * random.random((count, len(box))) for box in boxes]
    drawn[1] = whole(model.conditions, drawn[1])
    drawn[2] = np.concatenate([drawn[2], random.random((count, len(model.delays)))], axis=1)
    own = exported.constants * (1 + spread * random.uniform(-1, 1, (count, len(exported.constants))))
    own[0] = exported.constants
    t = exported.start + random.random(count)
    sizes = [1, *(part.shape[1] for part in drawn), len(exported.constants)]
    directions = [random.standard_normal((count, size)) for size in sizes]
    along = (directions[0][:, 0], directions[1], directions[2], directions[3], directions[4])
    return Points(t, drawn[0], drawn[1], drawn[2], own, along)


def own(exported: Exported) -> Points:
    """The point at which the model starts, with its own values."""
    values = (exported.states, exported.conditions, exported.inputs, exported.constants)
    x, condition, inputs, constants = (np.array(value, dtype=np.float64)[None] for value in values)
    inputs = np.append(inputs, np.ones((1, len(exported.model.delays))), axis=1)
    still = (np.zeros(1), 0 * x, 0 * condition, 0 * inputs, 0 * constants)
    return Points(np.array([exported.start]), x, condition, inputs, constants, still)


def _boxes(items: Sequence[State | Condition | Input], values: Array) -> Array:
    out = []
    for item, value in zip(items, values, strict=True):
        if item.range is not None and item.range.bounded:
            out.append((item.range.low, item.range.high))
        else:
            ends = sorted((0.5 * value, 1.5 * value)) if value else (0.0, 1.0)
            out.append((ends[0], ends[1]))
    return np.array(out, dtype=np.float64).reshape(-1, 2)
