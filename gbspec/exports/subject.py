"""What is exported: a Model with its numbers, values for all that a user of the export may set, and its origin."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, NetworkNumbers, NotCoveredError, network_numbers, numbers_of
from gbspec.ir import METHODS, Explicit, Model, Range, whole
from gbspec.version import __version__

NOTHING_KNOWN = 1.0
"""The value of a state, condition or input of which the model says neither a value nor a range."""


@dataclass(frozen=True)
class Exported:
    """A Model with an instance of its generated module, which has the weights and constants.

    `source` says where it is from; `values` were set by the user; `step` is the largest step of the run's solver.
    """

    model: Model
    instance: GeneratedModule
    source: str
    values: Mapping[str, float] = field(default_factory=dict)
    step: float | None = None

    @property
    def method(self) -> Explicit:
        """The integration method of its steps. Raises NotCoveredError for one that needs the Jacobian."""
        method = METHODS[self.instance.solver]
        if not isinstance(method, Explicit):
            reason = f"its solver `{method.name}`, for stiff models, needs the Jacobian at each step"
            raise NotCoveredError(f"{reason}; `gbspec train --solver dopri5` takes explicit ones")
        return method

    @cached_property
    def constants(self) -> Array:
        """The values of all constants, known then learned."""
        return np.asarray(self.instance.weights["constants"], dtype=np.float64)

    @cached_property
    def networks(self) -> list[NetworkNumbers]:
        """The networks' numbers."""
        return network_numbers(self.instance)

    @cached_property
    def numbers(self) -> list[float]:
        """Numbers that forms of contracts use, in the order of `numbers_of`."""
        found = []
        for index, word, place in numbers_of(self.model):
            one = self.networks[index]
            kept = {"center": one.output_center, "scale": one.output_scale, "input_scale": one.input_scale}
            found.append(float(kept[word][place]))
        return found

    @cached_property
    def states(self) -> Array:
        """Initial values: the model's guess, the mean of learned ones, or the middle of the range."""
        known = self.instance.weights.get("initial")
        learned = np.full(len(self.model.states), np.nan) if known is None else np.nanmean(np.asarray(known), axis=0)
        found = [
            _first(state.start, float(mean), _middle(state.range))
            for state, mean in zip(self.model.states, learned, strict=True)
        ]
        return np.array(found, dtype=np.float64)

    @cached_property
    def conditions(self) -> Array:
        """Values of the conditions: set by the user, the default, or the middle of the range."""
        found = [_first(self.values.get(c.name), c.default, _middle(c.range)) for c in self.model.conditions]
        return whole(self.model.conditions, np.array(found, dtype=np.float64))

    @cached_property
    def inputs(self) -> Array:
        """Values of the inputs, likewise."""
        found = [_first(self.values.get(i.name), i.default, _middle(i.range)) for i in self.model.inputs]
        return np.array(found, dtype=np.float64)

    @property
    def start(self) -> float:
        """The time at which a simulation starts."""
        return self.model.time.start or 0.0

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 (hexadecimal) of the model's text, the method and all numbers: equal ones compute the same."""
        found = hashlib.sha256(f"{self.model.text}\0{self.instance.solver}\0".encode())
        for name in sorted(self.instance.weights):
            array = np.ascontiguousarray(self.instance.weights[name], dtype="<f8")
            found.update(f"{name}{array.shape}".encode())
            found.update(array.tobytes())
        return found.hexdigest()

    @property
    def origin(self) -> dict[str, str]:
        """What every export carries beside the model's text."""
        return {
            "model": self.model.name,
            "source": self.source,
            "fingerprint": self.fingerprint,
            "gbspec": __version__,
            "solver": self.instance.solver,
        }


def _middle(range: Range | None) -> float | None:
    if range is None or not range.bounded:
        return None
    return 0.5 * (range.low + range.high)


def _first(*values: float | None) -> float:
    """The first known value."""
    return next((float(v) for v in values if v is not None and math.isfinite(v)), NOTHING_KNOWN)
