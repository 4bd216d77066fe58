"""The stage of growing horizons: segments of few rows are fitted first, then longer ones, then whole trajectories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, State, scalar
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.segments import GROWTH, Segments, divisible, horizons
from gbspec.training.stages import Effort, StageName
from gbspec.training.starts import refit_starts

ITERATIONS: dict[Effort, int] = {"low": 6, "normal": 15, "high": 30}
"""Largest number of iterations with segments of one length."""
ATTEMPTS: dict[Effort, int] = {"low": 1, "normal": 6, "high": 6}
"""Number of starting vectors that are tried until whole solutions follow the data."""
FOLLOWED = 0.005
"""A mean loss of whole solutions below this (R² above 0.99) needs no further attempt."""
AS_SEGMENTS = 3.0
"""Nor does one below this multiple of the loss of the shortest segments, which is due to noise then: segments have
initial states of their own, which follow part of the noise."""
LIMITED = (1, 3)
"""The attempts whose horizons begin with Huber's function, so that segments far from the data count little: an ignition
at a wrong time in few of them can otherwise keep all the others from the dynamics."""
SMALL_RIDGE = 1e-8
"""Precision of the weights' prior relative to that of the residuals: it only keeps the equations regular."""
CANDIDATES = 8
"""Number of initial states tried for each segment in a comparison of vectors."""
INNER = "segments."
"""Prefix of the entries of the optimiser of segments in the stage's state."""


class GrowingHorizons:
    """Fits segments of growing length by least squares, from one starting vector after the other.

    The next starting vector is tried where whole solutions do not follow the data: their loss is not below `followed`,
    by default a multiple of that of the shortest segments. In some attempts large residuals are limited in the first
    iterations with segments of each length, before least squares. Of the vectors reached with segments of any length
    the one with the smallest product of two losses, neither of them limited, is kept: of the shortest segments, and of
    whole solutions; where segments can only be beginnings, the one with the smallest loss of whole solutions. Where
    noise alone separates solutions from the data, that is the last one; where the system itself is disturbed, long
    segments distort the dynamics that short ones show.
    """

    name = StageName.HORIZONS.value

    def __init__(
        self,
        context: Context,
        whole: Parameters,
        starts: Sequence[Array],
        effort: Effort,
        growth: float = GROWTH,
        followed: float | None = None,
    ) -> None:
        self.context, self.whole, self.starts = context, whole, list(starts)
        self.horizons = horizons(context, growth)
        self.most, self.followed = ITERATIONS[effort], followed
        self.limiting = self.most // 2
        self.total = self.most * len(self.horizons) * len(self.starts)
        self._made: dict[int, Segments] = {}

    def begin(self, theta: Array) -> State:
        """The initial state: the vector of whole trajectories, and the first attempt's vector of segments."""
        state: State = {"theta": theta, "best": theta, "score": np.array(np.inf), "loss": np.array(np.inf)}
        return state | {"short": np.array(np.inf)} | self._attempt(0)

    def step(self, state: State, iteration: int) -> Outcome:
        """One iteration of Levenberg-Marquardt; after the last one with these segments, the next longer ones."""
        horizon, done = int(scalar(state, "horizon")), int(scalar(state, "done")) + 1
        inner = {name.partition(INNER)[2]: value for name, value in state.items() if name.startswith(INNER)}
        limited = int(scalar(state, "attempt")) in LIMITED and done <= self.limiting
        outcome = self._optimiser(horizon, limited).step(inner, iteration)
        theta = self._segments(horizon).merged(outcome.state["theta"])
        new = {**state, **_inner(outcome.state), "done": np.array(float(done)), "theta": theta}
        if limited and outcome.done:
            again = self._optimiser(horizon).begin(outcome.state["theta"])
            return Outcome({**new, **_inner(again), "done": np.array(float(self.limiting))}, outcome.loss, False)
        if not (outcome.done or done >= self.most):
            return Outcome(new, outcome.loss, False)
        return self._after_horizon(self._compared(new, horizon, outcome.loss), horizon, outcome)

    def run(self, theta: Array) -> Array:
        """The vector at the end of all steps. Raises ComputationError if one of them is impossible."""
        state = self.begin(theta)
        for iteration in range(self.total):
            outcome = self.step(state, iteration)
            state = outcome.state
            if outcome.done:
                break
        return state["theta"]

    def _compared(self, state: State, horizon: int, loss: float) -> State:
        """The state with the better one of the best vector so far and the present one, which has this loss of segments
        of this horizon."""
        news = self._scored(state["theta"])
        return {**state, **news} if scalar(news, "score") < scalar(state, "score") else state

    def _scored(self, theta: Array) -> State:
        """The entries of the state for the best vector, with the product of its losses."""
        short, whole = self.losses(theta)
        # Beginnings alone do not show the dynamics of the whole.
        score = short * whole if divisible(self.context.model) else whole
        score = score if np.isfinite([short, whole]).all() else np.inf
        return {"score": np.array(score), "short": np.array(short), "loss": np.array(whole), "best": theta}

    def _after_horizon(self, state: State, horizon: int, outcome: Outcome) -> Outcome:
        """Goes on to the next horizon, or to the next attempt, or ends."""
        following = self._next(horizon, self._segments(horizon), outcome.state["theta"])
        if following is not None:
            return Outcome({**state, **following}, outcome.loss, False)
        return self._after_attempt(state, outcome)

    def _after_attempt(self, state: State, outcome: Outcome, enough: bool = False) -> Outcome:
        """Goes on to the next attempt, or ends."""
        loss, attempt = scalar(state, "loss"), int(scalar(state, "attempt")) + 1
        followed = max(FOLLOWED, AS_SEGMENTS * scalar(state, "short")) if self.followed is None else self.followed
        if enough or loss < followed or attempt >= len(self.starts):
            return Outcome({"theta": state["best"]}, loss, True, "" if np.isfinite(loss) else BLOWN_UP)
        return Outcome({**state, **self._attempt(attempt)}, loss, False)

    def losses(self, theta: Array) -> tuple[float, float]:
        """The losses of the shortest segments, with refitted initial states, and of whole solutions."""
        whole = self.context.engine(self.whole, 0.0)
        return short_loss(self.context, self._segments(0), theta), mean_loss(residual_vector(whole, theta))

    def _attempt(self, number: int) -> State:
        """The state at the beginning of an attempt: this one, or the next one whose solutions do not blow up."""
        segments = self._segments(0)
        vectors = [segments.vector(start, None) for start in self.starts[number:]]
        finite = (i for i, one in enumerate(vectors) if np.isfinite(residual_vector(segments.engine, one)).all())
        skipped = next(finite, 0)
        return self._begun(vectors[skipped], 0) | {"attempt": np.array(float(number + skipped))}

    def _next(self, horizon: int, segments: Segments, theta: Array) -> State | None:
        """The state at the beginning of the next horizon; None after the last one, or if its solutions blow up."""
        if horizon + 1 >= len(self.horizons):
            return None
        longer = self._segments(horizon + 1)
        vector = longer.vector(segments.merged(theta), segments.states(theta))
        if not np.isfinite(residual_vector(longer.engine, vector)).all():
            return None
        return self._begun(vector, horizon + 1)

    def _begun(self, theta: Array, horizon: int) -> State:
        begun = _inner(self._optimiser(horizon).begin(theta))
        return begun | {"horizon": np.array(float(horizon)), "done": np.array(0.0)}

    def _optimiser(self, horizon: int, limited: bool = False) -> LevenbergMarquardt:
        segments = self._segments(horizon)
        options = LevenbergOptions(robust=limited, tolerance=1e-2, damping=1e-2, ridge=SMALL_RIDGE)
        return LevenbergMarquardt(self.name, self.most, lambda iteration: segments.engine, options)

    def _segments(self, horizon: int) -> Segments:
        if horizon not in self._made:
            self._made[horizon] = Segments.of(self.context, self.whole, self.horizons[horizon])
        return self._made[horizon]


def other_weights(context: Context, parameters: Parameters, theta: Array, number: int) -> Array:
    """A vector of this layout with other random weights, those of a number."""
    other = type(context.module).random(1000 * number + context.seed).weights
    out = theta.copy()
    out[: parameters.n_weights] = parameters.vector(other)[: parameters.n_weights]
    return out


def short_loss(context: Context, segments: Segments, theta: Array) -> float:
    """The loss of segments at a vector of whole trajectories, with refitted initial states of the segments."""
    fitted = refit_starts(segments.engine, segments.vector(theta, None), context.seed, CANDIDATES)
    return mean_loss(residual_vector(segments.engine, fitted))


def _inner(state: State) -> State:
    """The state of the optimiser of segments, as part of the stage's."""
    return {f"{INNER}{name}": value for name, value in state.items()}


BLOWN_UP = "solutions of growing segments of the trajectories blew up before they were as long as the trajectories"
