"""A recognition network: from a trajectory's first measurements to its initial state.

It is trained after the dynamics. Every row of every training trajectory begins a window; the measurements in the window
are the inputs and the fitted state at its first row is the target, so that few trajectories give many examples. For a
new trajectory the network then gives a guess of its unmeasured states, with an estimate of the error, before any fit.
"""

from __future__ import annotations

import numpy as np
import torch

from gbspec.arrays import Array, Mask
from gbspec.data import PREFIX, features
from gbspec.training.engines import predicted
from gbspec.training.problem import Parameters, Weights
from gbspec.training.recipe.context import Context

ROWS, WIDTH, STEPS, RATE = 6, 16, 600, 1e-2
"""Mean intervals that a window spans, hidden units, steps of Adam, and their size."""
DECAY = 1e-3
HELD = 5
"""One trajectory in this many (of a single one, the last windows) is used for the error and for early stopping."""


def recognition(context: Context, parameters: Parameters, theta: Array, blend: float) -> Weights:
    """The arrays of the network (see `gbspec.data.window`), fitted to the states of the solution at `theta`.

    Empty if there are no windows to learn from.
    """
    offsets = _offsets(context)
    x, y, owner = _examples(context, parameters, theta, blend, offsets)
    if len(x) < 2 * HELD:
        return {}
    number = np.unique(owner, return_inverse=True)[1]
    last = np.arange(len(x)) >= len(x) * (HELD - 1) // HELD
    judge: Mask = number % HELD == HELD - 1 if number.max() >= HELD - 1 else last
    center, scale = x.mean(axis=0), _column_sds(x)
    state_center, state_scale = y.mean(axis=0), _column_sds(y)
    layers, error = _fit((x - center) / scale, (y - state_center) / state_scale, judge, context.seed)
    arrays = {"offsets": offsets, "center": center, "scale": scale, "state_center": state_center}
    arrays |= {"state_scale": state_scale, "error": error * state_scale, **layers}
    return {PREFIX + name: value for name, value in arrays.items()}


def _offsets(context: Context) -> Array:
    intervals = np.concatenate([np.diff(item.times) for item in context.trajectories.items])
    return np.arange(ROWS + 1, dtype=np.float64) * (float(intervals.mean()) if len(intervals) else 1.0)


def _examples(
    context: Context, parameters: Parameters, theta: Array, blend: float, offsets: Array
) -> tuple[Array, Array, Array]:
    """Inputs [M, n_features], states [M, n_states] and trajectories [M] of all windows."""
    problem = context.problem(blend)
    states = predicted(context.choice.engine(problem, parameters), theta).after
    packed, inputs, targets, owners = problem.packed, [], [], []
    for row in range(packed.rows):
        owner = int(packed.row_trajectory[row])
        seen = features(context.model, context.trajectories.items[owner], float(packed.row_time[row]), offsets)
        if seen is not None and np.isfinite(states[row]).all():
            inputs.append(seen)
            targets.append(states[row])
            owners.append(owner)
    width = len(inputs[0]) if inputs else 0
    return np.array(inputs).reshape(-1, width), np.array(targets).reshape(-1, states.shape[1]), np.array(owners)


def _column_sds(columns: Array) -> Array:
    found = columns.std(axis=0)
    return np.where(found > 0, found, 1.0)


def _fit(x: Array, y: Array, judge: Mask, seed: int) -> tuple[Weights, Array]:
    """One hidden layer by Adam on all windows; the weights that best predict the windows `judge`, and their error."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"hidden_weight": (WIDTH, x.shape[1]), "hidden_bias": (WIDTH,), "weight": (y.shape[1], WIDTH)}
    layers = {
        name: (torch.randn(shape, generator=generator, dtype=torch.float64) / shape[-1] ** 0.5).requires_grad_()
        for name, shape in shapes.items()
    }
    layers["bias"] = torch.zeros(y.shape[1], dtype=torch.float64, requires_grad=True)
    inputs, targets, held = torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(judge)
    optimiser = torch.optim.AdamW(list(layers.values()), lr=RATE, weight_decay=DECAY)
    best, kept = np.inf, {name: value.detach().numpy().copy() for name, value in layers.items()}
    error = np.ones(y.shape[1])
    for _ in range(STEPS):
        hidden = torch.tanh(inputs @ layers["hidden_weight"].T + layers["hidden_bias"])
        off = hidden @ layers["weight"].T + layers["bias"] - targets
        judged = float((off[held].detach() ** 2).mean())
        if judged < best:
            best, error = judged, np.sqrt((off[held].detach().numpy() ** 2).mean(axis=0))
            kept = {name: value.detach().numpy().copy() for name, value in layers.items()}
        optimiser.zero_grad()
        (off[~held] ** 2).mean().backward()
        optimiser.step()
    return kept, error
