"""The stage that maximises the marginal likelihood: damped scoring, from exact gradients and expected information.

Between two iterations its state is the trainable vector, the modes z, the damping and the ridge; the rest follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch

from gbspec.arrays import Array, Mask
from gbspec.diagnostics import ComputationError
from gbspec.training.optimise import Outcome, State, not_at_maximum, promised_fall
from gbspec.training.population.likelihood import Likelihood
from gbspec.training.population.objective import Objective, Point
from gbspec.training.population.undefined import undefined
from gbspec.training.problem import Bijection, Parameters

Failure: TypeAlias = Callable[[Array], Exception]
"""The error to raise if the model cannot be solved at a vector."""

FALL = 1e-9
"""The stage has converged when the fall of -2 log L that the next step promises is below this, absolutely or as a part
of the objective; the square root of this is about the error of a parameter in its standard deviations."""
FALL_OF_QUADRATURE = 1e-8
"""The same by quadrature, whose steps cost far more: the information is that of Laplace's method, so that they shrink
by a constant factor."""
SLOW, TIMES = 0.5, 5
"""Where networks are learned, whose weights move along long flat valleys, the stage ends when so many iterations have
lowered the objective by less than this: half of what one parameter without effect changes by chance."""
OFTEN = 5
"""With networks the modes are sought from several starts in every so many iterations."""
TRIALS, DAMPED = 14, 1e-3
"""Damped steps that are tried in one iteration, and the damping of the first one."""
STUCK, ROUND = 1e-3, 10
"""A constant closer to a bound than this part of the bounds' width is there; iterations from each start."""
APART = 0.1
"""Starts are different where a parameter differs by more than this: a factor of 1.35."""
LONGEST = 0.7
"""No parameter moves further than this in one step: a factor of e^2."""


def vector_of(parameters: Parameters, likelihood: Likelihood, weights: Array, u: Array, z: Array) -> Array:
    """The trainable vector with individual constants at the modes z [units, size]."""
    layout = likelihood.layout
    theta = np.zeros(parameters.size)
    theta[: parameters.n_weights], theta[layout.slice()] = weights, u
    if parameters.own:
        with torch.no_grad():
            natural = layout.natural(torch.from_numpy(u)).expand(parameters.trajectories, -1)
            constants = likelihood.individual(natural, torch.from_numpy(z))[0].numpy()
        local = theta[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
        local[:, : len(parameters.own)] = parameters.bijections(parameters.own).from_natural(
            constants[:, list(parameters.own)]
        )
    return theta


def modes_of(parameters: Parameters, likelihood: Likelihood, theta: Array) -> Array:
    """The standard numbers [units, size] of the individual constants in a trainable vector: where modes are sought
    first."""
    layout = likelihood.layout
    with torch.no_grad():
        known = len(parameters.model.constants)
        individual = parameters.constants(torch.from_numpy(theta))[:, known:][:, layout.place]
        natural = layout.natural(torch.from_numpy(theta[layout.slice()])).expand(parameters.trajectories, -1)
        return likelihood.groups.together(layout.numbers(natural, individual).numpy())


@dataclass(frozen=True)
class Starts:
    """Other vectors from which the likelihood may begin: those that lie `elsewhere`, and where constants are at bounds
    in all of them, `inside` (None: with declared values in place of those at bounds, and of all)."""

    elsewhere: tuple[Array, ...] = ()
    inside: Array | None = None


class MarginalLikelihood:
    """The stage. By quadrature it begins with the maximum of Laplace's method, from which few steps are left.

    With `others` the vector is not the only start: a pooled fit may have ended in a minimum that is not the
    population's, or at bounds, from which a logistic scale does not lead away. What comes furthest in a few iterations
    is gone on with.
    """

    def __init__(
        self,
        name: str,
        total: int,
        parameters: Parameters,
        objective: Objective,
        ridge: float | None,
        failure: Failure,
        others: Starts | None = None,
        said: str = "",
    ) -> None:
        self.said = said  # of the step, after the likelihood
        self.name, self.total, self.parameters = name, total, parameters
        self.whole, self.failure, self.others = objective, failure, others
        self.objective = objective.by_laplace()
        self.layout, self.likelihood = objective.layout, objective.marginal.likelihood
        # None: the ridge of greatest evidence.
        self.ridge = ridge

    def begin(self, theta: Array) -> State:
        """The state at a vector, or at another start that leads further."""
        starts = [theta] if self.others is None else self._starts(theta, self.others)
        states = [self._begun(each) for each in starts]
        return self._furthest(states) if len(states) > 1 else states[0]

    def _starts(self, theta: Array, others: Starts) -> list[Array]:
        """The starts, different from each other."""
        found = [theta]
        for other in others.elsewhere:
            found += [other] if all(self._apart(other, one) for one in found) else []
        stuck = [self._at_bounds(each[self.layout.slice()]) for each in found]
        if not all(each.any() for each in stuck):
            return found
        return found + (self._declared(theta, stuck[0]) if others.inside is None else [others.inside])

    def _apart(self, one: Array, other: Array) -> bool:
        """Whether two vectors differ in a parameter by more than `APART`."""
        return bool(np.abs(one[self.layout.slice()] - other[self.layout.slice()]).max(initial=0.0) > APART)

    def _at_bounds(self, u: Array) -> Mask:
        """Which parameters u [P] are at bounds."""
        natural = self.layout.bijections.to_natural(torch.from_numpy(u)).numpy()
        near = [
            any(Bijection.of(k).distance(value, bound) < STUCK for bound in (k.range.low, k.range.high))
            for k, value in zip(self.layout.each, natural, strict=True)
        ]
        return np.array(near, dtype=np.bool_)

    def _declared(self, theta: Array, stuck: Mask) -> list[Array]:
        """The vectors with declared values in place of those at bounds, and of all."""
        layout, weights = self.layout, theta[: self.parameters.n_weights]
        declared = layout.bijections.from_natural(np.array([k.start for k in layout.each], dtype=np.float64))
        none = np.zeros((self.likelihood.groups.count, self.likelihood.groups.size))
        return [
            vector_of(
                self.parameters, self.likelihood, weights, np.where(instead, declared, theta[layout.slice()]), none
            )
            for instead in (stuck, np.ones_like(stuck))
        ]

    def _furthest(self, states: list[State]) -> State:
        """The state with the smallest objective after some iterations from each."""
        best, least = states[0], np.inf
        for state in states:
            try:
                for iteration in range(ROUND):
                    outcome = self.step(state, iteration)
                    state = outcome.state
                    if outcome.done:
                        break
            except ComputationError:
                continue
            if outcome.loss < least:
                best, least = state, outcome.loss
        return best

    def _begun(self, theta: Array) -> State:
        """The state at a vector; the modes are found from its individual constants."""
        z = modes_of(self.parameters, self.likelihood, theta)
        first = 1.0 if self.ridge is None else self.ridge
        ridge = first if self.parameters.n_weights else 0.0
        state: State = {"theta": theta, "z": z, "damping": np.array(DAMPED), "ridge": np.array(ridge)}
        return state | {"falls": np.full(TIMES, np.inf), "quadrature": np.array(0.0)}

    def going_on(self, theta: Array) -> State:
        """The state at a vector from which this stage or one like it has come to rest: of quadrature, if asked for."""
        return self._begun(theta) | {"quadrature": np.array(1.0)}

    def step(self, state: State, iteration: int) -> Outcome:
        """One damped step. Raises ComputationError where the model cannot be solved at the present vector, or the
        likelihood there or a derivative of it is not a finite number."""
        of_quadrature = bool(state.get("quadrature", 0.0))
        self.objective = self.whole if of_quadrature else self.whole.by_laplace()
        theta, ridge, damping = state["theta"], float(state["ridge"]), float(state["damping"])
        weights, u = theta[: self.parameters.n_weights], theta[self.layout.slice()]
        now = self.objective.at(weights, u, state["z"], ridge, afresh=iteration % OFTEN == 0)
        if not np.isfinite(now.objective):
            raise self._undefined(now, None, iteration)
        if self.parameters.n_weights and self.ridge is None:
            ridge = self.objective.evident_ridge(now, ridge)
            now = Point(weights, u, now.minus2ll + self._penalty(now, ridge), now.minus2ll, now.z)
        gradient = self.objective.gradient(now, ridge)
        curvature = self.objective.curvature(now, ridge)
        if not (np.isfinite(gradient).all() and np.isfinite(curvature).all()):
            raise self._undefined(now, gradient, iteration)
        new, promised, damping = self._trial(now, gradient, curvature, ridge, damping)
        fell = now.objective - new.objective
        falls = np.append(state["falls"][1:], fell)
        enough = max(FALL_OF_QUADRATURE if of_quadrature else FALL, self.likelihood.uncertain)
        slow = bool(self.parameters.n_weights) and float(falls.sum()) < SLOW
        rests = promised < enough * (1 + abs(now.objective)) or slow
        last = rests or new is now
        moved = vector_of(self.parameters, self.likelihood, new.weights, new.u, new.z)
        reached: State = {"theta": moved, "z": new.z, "damping": np.array(damping), "ridge": np.array(ridge)}
        reached["falls"], reached["quadrature"] = falls, np.array(float(of_quadrature or last))
        if last and not of_quadrature and self.whole is not self.objective:
            reached["damping"], last = np.array(DAMPED), False
        ended = last or iteration + 1 == self.total
        short = None if rests or not ended else self._unfinished(new, ridge, iteration, new is now)
        values = max(int(self.objective.marginal.predictions.problem.seen.sum()), 1)
        said = f"-2 log likelihood {new.minus2ll:.6g}{self.said}"
        return Outcome(reached, new.objective / (2 * values), last, remark=said, unfinished=short)

    def _unfinished(self, point: Point, ridge: float, iteration: int, stuck: bool) -> ComputationError | None:
        """What is to be said where the stage ends at a point without resting; constants at bounds do not count."""
        gradient, curvature = self.objective.gradient(point, ridge), self.objective.curvature(point, ridge)
        moving = np.concatenate([np.ones(len(point.weights), dtype=np.bool_), ~self._at_bounds(point.u)])
        return not_at_maximum(promised_fall(gradient, curvature, moving), iteration + 1, stuck)

    def _undefined(self, point: Point, gradient: Array | None, iteration: int) -> Exception:
        """The error to raise where the objective, or its derivatives, are no finite numbers."""
        when = f"in iteration {iteration + 1}"
        found = undefined(self.likelihood, point, gradient, when)
        none = np.zeros_like(point.z)
        return found or self.failure(vector_of(self.parameters, self.likelihood, point.weights, point.u, none))

    def _penalty(self, point: Point, ridge: float) -> float:
        """The part of the objective that is not the likelihood, with another ridge."""
        empty = self.objective.at(point.weights, point.u, point.z, ridge)
        return empty.objective - empty.minus2ll

    def _trial(
        self, now: Point, gradient: Array, curvature: Array, ridge: float, damping: float
    ) -> tuple[Point, float, float]:
        """The first damped step that lowers the objective, the fall that a hardly damped one promises, and the
        damping."""
        diagonal = np.maximum(np.diag(curvature), 1e-8 * max(float(np.diag(curvature).max()), 1e-300))
        newton = np.linalg.solve(curvature + min(damping, DAMPED) * np.diag(diagonal), gradient)
        promised, count = 0.5 * float(gradient @ newton), len(now.weights)
        most = now.objective + self.likelihood.uncertain * (1 + abs(now.objective))
        stuck = np.concatenate([np.zeros(count, dtype=np.bool_), self._at_bounds(now.u)])
        for trial in range(TRIALS):
            damped = curvature + damping * np.diag(diagonal)
            step = np.asarray(-np.linalg.solve(damped, gradient), dtype=np.float64)
            step = _limited(step, damped, gradient, count, stuck)
            new = self.objective.at(now.weights + step[:count], now.u + step[count:], now.z, ridge)
            if new.objective <= most:
                # A step that was tried in vain is not tried again at once.
                return new, promised, max(damping / (10 if trial == 0 else 3), 1e-9)
            damping = max(damping * 6, 1e-4)
        return now, promised, DAMPED


def _limited(step: Array, damped: Array, gradient: Array, count: int, stuck: Mask) -> Array:
    """The step, of which no parameter after the first `count` (weights) moves further than `LONGEST`.

    Where a constant is at its bound the slope of its scale vanishes, so that its step is endless. It moves by `LONGEST`
    alone (`stuck`), and the others by what goes with that: shortened along with it, they would not move at all.
    """
    endless = stuck & (np.abs(step) > LONGEST)
    step = np.where(endless, np.clip(step, -LONGEST, LONGEST), step)
    rest = ~endless
    if endless.any() and rest.any():
        pull = gradient[rest] + damped[np.ix_(rest, endless)] @ step[endless]
        step[rest] = -np.linalg.solve(damped[np.ix_(rest, rest)], pull)
    longest = float(np.abs(step[count:][rest[count:]]).max(initial=0.0))
    step[rest] *= min(1.0, LONGEST / longest) if longest > 0 else 1.0
    return step
