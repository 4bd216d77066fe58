"""The stage of Adam on minibatches of trajectories, with a one-cycle schedule."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, half_squares, residual_vector
from gbspec.training.optimise.adam_update import AdamMoments, one_cycle
from gbspec.training.optimise.priors import priors_at
from gbspec.training.optimise.stage import Outcome, State, require_finite, scalar
from gbspec.training.options import TrainOptions
from gbspec.training.problem import mean_loss


class Adam:
    """Adam (Kingma and Ba 2015); each step of the stage is an epoch.

    The learning rate rises over the first tenth and falls as a cosine (one cycle); gradients are clipped to norm 1.
    The draw of minibatches depends only on the seed and the epoch's number, so that a resumed stage draws the same
    ones.
    """

    def __init__(
        self,
        name: str,
        total: int,
        engine_at: Callable[[int], Engine],
        options: TrainOptions,
        seed: int,
    ) -> None:
        self.name, self.total, self.engine_at = name, total, engine_at
        self.options, self.seed = options, seed

    def begin(self, theta: Array) -> State:
        """The initial state: the vector, both moments, and the number of updates."""
        return {
            "theta": theta,
            "first": np.zeros_like(theta),
            "second": np.zeros_like(theta),
            "updates": np.array(0.0),
        }

    def step(self, state: State, iteration: int) -> Outcome:
        """One pass over all trajectories."""
        engine, theta = self.engine_at(iteration), state["theta"]
        packed = engine.problem.packed
        measured = np.bincount(packed.row_trajectory, engine.problem.seen.sum(1), packed.trajectories)
        priors = priors_at(engine, theta)
        moments = AdamMoments(state["first"], state["second"], int(scalar(state, "updates")))
        order = np.random.default_rng([self.seed, 61, iteration]).permutation(packed.trajectories)
        batch = self.options.batch_size
        total = -(-len(order) // batch) * self.total
        for begin in range(0, len(order), batch):
            index = np.sort(order[begin : begin + batch]).astype(np.int64)
            value, gradient = half_squares(engine, theta, index)
            if not np.isfinite(value) or not np.isfinite(gradient).all():
                require_finite(engine, theta, np.array([np.nan]), self.name)
            gradient /= max(int(measured[index].sum()), 1)
            gradient += priors.gradient(theta) / max(int(measured.sum()), 1)
            rate = one_cycle(moments.updates + 1, total, self.options.learning_rate)
            moments, step = moments.advance(gradient, rate)
            theta = theta + step
        residuals = residual_vector(engine, theta)
        require_finite(engine, theta, residuals, self.name)
        after: State = {
            "theta": theta,
            "first": moments.first,
            "second": moments.second,
            "updates": np.array(float(moments.updates)),
        }
        return Outcome(after, mean_loss(residuals), False)
