"""The search for constants that occur only where values jump.

The time of a jump (`if(t > lag, 1, 0)`) enters no value: the likelihood has no derivative by it, and no damped step
moves it, unless steps of the solver end at jumps, and then only where a solution passes it. Each such constant is tried
at values spread over its range, on the scale of this range, and then at ever smaller distances from the best one, until
the objective settles; at each value everything is improved by a few steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.optimise import Outcome, State
from gbspec.training.population.stage import MarginalLikelihood, vector_of

SPREAD, HALVINGS = 16, 24
"""Values over the whole range of a constant, and most further ones around the best of them."""
NEAR, NEAR_HALVINGS = 4, 16
"""The same where a search with longer steps has been made: over the distance of two values of that one."""
LEAST = 6
"""So many of the further values are tried at least."""
STEPS, ENOUGH = 8, 0.02
"""Most damped steps at each value; they end where one has lowered the objective, as -2 log likelihood, by less."""
SETTLED = 0.1
"""The search ends where the values beside the best one, on both sides, have an objective that is larger by less."""
UNBOUNDED = 2.0
"""Without bounds values are tried so many times the size of the present one to either side."""


@dataclass(frozen=True)
class _Tried:
    """The values of one constant that were tried, on the scale of its range, with the losses there."""

    values: Array
    losses: Array

    def next(self, ends: tuple[float, float], spread: int) -> float:
        """The first value is the present one; then `spread` values between the ends; then the middle of the wider
        interval beside the best value."""
        done, (low, high) = len(self.values) - 1, ends
        if done < spread:
            return low + (done + 0.5) / spread * (high - low)
        best = float(self.values[int(np.argmin(self.losses))])
        below, above = self.values[self.values < best], self.values[self.values > best]
        left, right = float(below.max(initial=low)), float(above.min(initial=high))
        return (left + best) / 2 if best - left > right - best else (best + right) / 2

    def settled(self, spread: int, enough: float) -> bool:
        """Whether the values beside the best one, on both sides, have a loss that is larger by at most `enough`."""
        if len(self.values) - 1 < spread + LEAST:
            return False
        order, first = np.argsort(self.values, kind="stable"), int(np.argmin(self.losses))
        best = int(np.flatnonzero(order == first)[0])  # of several that are equal the first one, as `next` has it
        beside = self.losses[order[max(best - 1, 0) : best + 2]]
        return len(beside) == 3 and bool((beside <= self.losses[first] + enough).all())


class TimesOfJumps:
    """The stage: one value of one constant in each iteration. `places` are those of the constants among the parameters
    u, `near` whether a search with longer steps has been made before."""

    def __init__(self, name: str, inner: MarginalLikelihood, places: Sequence[int], near: bool) -> None:
        self.name, self.inner, self.layout = name, inner, inner.layout
        self.places, self.near = tuple(places), near
        self.total = values_of(near) * len(self.places)

    def begin(self, theta: Array) -> State:
        """The state at a vector: nothing has been tried."""
        nothing = {"least": np.array(np.inf), "tried": np.zeros((0, 2)), "turn": np.array(0)}
        return self.inner.begin(theta) | nothing

    def step(self, state: State, iteration: int) -> Outcome:
        """Tries one value, and goes on from the best one. Raises ComputationError where the model cannot be solved at
        the present vector."""
        turn, before = int(state.get("turn", 0)), state["tried"]
        place, spread, count = self.places[turn], NEAR if self.near else SPREAD, len(before)
        if count:
            tried = _Tried(self._scaled(place, before[:, 0]), before[:, 1])
            value = self._value(place, tried.next(self._ends(place, float(before[0, 0])), spread))
        else:
            value = self._present(state, place)
        moved = self._improved(self._with(state, place, value) if count else state, strict=not count)
        least, loss = float(state["least"]), np.inf if moved is None else moved.loss
        better = moved is not None and loss < least
        kept = moved.state if moved is not None and better else state
        value = value if moved is None else self._present(moved.state, place)  # steps may have moved it
        after = np.vstack([before, [value, loss]])
        best = float(after[int(np.argmin(after[:, 1])), 0])
        said = f"`{self.layout.each[place].name}` {best:.5g} is the best of {len(after)} values"
        tried = _Tried(self._scaled(place, after[:, 0]), after[:, 1])
        ended = len(after) >= values_of(self.near) or tried.settled(spread, self._loss_of(SETTLED))
        last = ended and turn + 1 == len(self.places)
        going = {"tried": after[:0], "turn": np.array(turn + 1)} if ended and not last else {"tried": after}
        reached = {**kept, "least": np.array(min(loss, least)), "turn": np.array(turn), **going}
        return Outcome(reached, min(loss, least), last, "", said)

    def _present(self, state: State, place: int) -> float:
        """The value of a constant."""
        return float(self.layout.natural(torch.from_numpy(state["theta"][self.layout.slice()]))[place])

    def _loss_of(self, rise: float) -> float:
        """A difference of -2 log likelihood as one of the objective."""
        return rise / (2 * max(len(self.inner.likelihood.value), 1))

    def _improved(self, state: State, strict: bool) -> Outcome | None:
        """What a few steps lead to; None where the model cannot be solved, unless that is an error (`strict`)."""
        inner = {name: value for name, value in state.items() if name not in ("least", "tried", "turn")}
        outcome, before = None, np.inf
        enough = self._loss_of(ENOUGH)
        try:
            for iteration in range(STEPS):
                # By the quadrature that was asked for, without Laplace's method before it.
                outcome = self.inner.step({**inner, "quadrature": np.array(1.0)}, iteration)
                inner = outcome.state
                if outcome.done or before - outcome.loss < enough:
                    break
                before = outcome.loss
        except ComputationError:
            if strict:
                raise
            return None
        return outcome

    def _with(self, state: State, place: int, value: float) -> State:
        """The state with another value of a constant, also of that of single trajectories."""
        theta, inner = state["theta"], self.inner
        u = theta[self.layout.slice()].copy()
        natural = self.layout.natural(torch.from_numpy(u)).numpy().copy()
        natural[place] = value
        u[place] = self.layout.bijections.from_natural(natural)[place]
        weights = theta[: inner.parameters.n_weights]
        return {
            **state,
            "theta": vector_of(inner.parameters, inner.likelihood, weights, u, state["z"]),
            "damping": np.array(1e-3),
        }

    def _scaled(self, place: int, values: Array) -> Array:
        """Values of a constant on the scale of its range: logarithms where its bounds are far apart."""
        bounds = self.layout.each[place].range
        sign = math.copysign(1.0, bounds.low)
        return np.asarray(sign * np.log(sign * values)) if bounds.logarithmic else values

    def _value(self, place: int, scaled: float) -> float:
        bounds = self.layout.each[place].range
        sign = math.copysign(1.0, bounds.low)
        return min(max(sign * math.exp(sign * scaled), bounds.low), bounds.high) if bounds.logarithmic else scaled

    def _ends(self, place: int, present: float) -> tuple[float, float]:
        """Between which values, on the scale of its range, a constant is sought, whose value was the `present` one when
        its search began."""
        bounds = self.layout.each[place].range
        low, high = bounds.low, bounds.high
        if not bounds.bounded:
            size = UNBOUNDED * (abs(present) or 1.0)
            low, high = max(low, present - size), min(high, present + size)
        low, present, high = self._scaled(place, np.array([low, present, high])).tolist()
        reach = (high - low) / SPREAD
        return (max(low, present - reach), min(high, present + reach)) if self.near else (low, high)


def values_of(near: bool) -> int:
    """How many values of each constant are tried at most."""
    return 1 + (NEAR + NEAR_HALVINGS if near else SPREAD + HALVINGS)
