"""The first measurements of a trajectory as inputs of a recognition network, for any measurement times."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbspec.arrays import Array
from gbspec.data.signals import evaluate
from gbspec.data.trajectories import Trajectory
from gbspec.ir import Model

PREFIX = "recognition."
"""The names of the network's arrays in a member's weights: offsets, center, scale, weight, bias, of the layers
`hidden_weight`, `hidden_bias`, `weight`, `bias`, the outputs' `state_center`, `state_scale`, and their `error`."""
LEAST = 3
"""The minimal number of measurements in a window for recognition."""


def features(model: Model, item: Trajectory, begin: float, offsets: Array) -> Array | None:
    """The features [n_features] of a window that begins at `begin`; None if it has too few measurements.

    Each channel's measurements from then on, interpolated linearly at `begin + offsets` (constant beyond the first and
    the last one), then the conditions, then the inputs at `begin`. A channel without any makes it None.
    """
    inside = (item.times >= begin - 1e-12) & (item.times <= begin + offsets[-1] * (1 + 1e-9))
    parts = []
    for column in item.values.T:
        rows = inside & np.isfinite(column)
        if not rows.any():
            return None
        parts.append(np.interp(begin + offsets, item.times[rows], column[rows]))
    if np.isfinite(item.values[inside]).sum() < LEAST:
        return None
    at = np.array([begin])
    inputs = [evaluate(s, one.interpolation, at)[0] for s, one in zip(item.inputs, model.inputs, strict=True)]
    return np.concatenate([*parts, item.condition, np.array(inputs, dtype=np.float64)])


def recognised(weights: Mapping[str, Array], model: Model, item: Trajectory) -> tuple[Array, Array] | None:
    """The initial state of a trajectory by a member's recognition network, and its error: [n_states] each.

    None if the member has no such network, or the trajectory too few measurements.
    """
    if PREFIX + "offsets" not in weights:
        return None
    own = {name.removeprefix(PREFIX): value for name, value in weights.items() if name.startswith(PREFIX)}
    seen = features(model, item, item.start, own["offsets"])
    if seen is None:
        return None
    hidden = np.tanh(own["hidden_weight"] @ ((seen - own["center"]) / own["scale"]) + own["hidden_bias"])
    state = own["state_center"] + own["state_scale"] * (own["weight"] @ hidden + own["bias"])
    return np.asarray(state, dtype=np.float64), own["error"]
