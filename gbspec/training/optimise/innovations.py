"""The stage that maximises the likelihood of innovations of a model with random disturbances.

A Levenberg-Marquardt method on the expected information (Fisher scoring), whose matrix needs first derivatives only and
is never indefinite. Weights of networks have a normal prior whose precision is that of the evidence (MacKay 1992):
with the effective number of weights gamma it is gamma / |w|^2. Constants have the priors that the model states. The
sizes of disturbances and noises are those of the restricted likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.data import Estimated
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Filtered, FilterEngine, Guess
from gbspec.training.optimise.certainty import Certainty
from gbspec.training.optimise.expected import ROUNDING, certainty_of
from gbspec.training.optimise.inner import inner
from gbspec.training.optimise.lost import not_finite
from gbspec.training.optimise.maximum import likeliest
from gbspec.training.optimise.near_none import higher, near_none
from gbspec.training.optimise.priors import Priors
from gbspec.training.optimise.released import released
from gbspec.training.optimise.restricted import FLAT, Restricted, inverse, place_of, sizes, slope
from gbspec.training.optimise.stage import Outcome, State, scalar
from gbspec.training.optimise.unfinished import not_at_maximum
from gbspec.training.problem import Integers

ATTEMPTS = 12
"""Number of dampings tried in one iteration before the stage ends."""
STRONG, USUAL = 1e3, 1.0
"""Where steps with a larger damping lower nothing, the stage ends; small gains of steps with more than the usual one
do not say that it rests."""
LONGEST = 0.7
"""Largest change of a constant in one step, in units of its trainable value (a factor of e^2.1); of a noise and of a
weight it is 2."""
SMALL = 1e-4
"""The stage ends when two steps raise the log likelihood by less: constants are then within hundredths of their sd."""
SETTLED = 1.0
"""Weights' prior is estimated from iterations that raise the log likelihood by less, and the restricted likelihood is
taken from the first of them on. Far from the maximum noises and disturbances are still so large that no function shows:
the prior would shrink weights to nothing, and stay."""
FIRST = 1e-2
"""The first precision of weights, over that of their first values."""
SCALES = ((1.0, 0.0), (0.1, -2.0))
"""Factors on disturbances and logarithms of factors on noises of the vectors that are tried."""
PINNED, LAST = 100.0, 0.2
"""The precision of weights with which functions are constants unless the data insist: that of the fit with which the
one with functions is compared. The share of the iterations that is left for it."""
CONSTANT = "constant."
"""What the entries of its state begin with."""
STARTS, ROUND = 3, 8
"""The number of vectors from which fits begin, and the iterations after which these are compared."""
LOWER, RELEASES = 1e-3, 3
"""A constant is released from its bound if that lowers the negative log likelihood by more; how often, at most: the
restricted likelihood may take a size back."""
MOMENTS = ("start_mean", "start_cov", "end_mean", "end_cov", "shares")
"""The filter's moments and steps in the state, from which the next search of them begins."""


@dataclass(frozen=True)
class _System:
    """The penalised objective at a vector: value, gradient and matrix; `found` is the filter there, and `information`
    the matrix without priors."""

    found: Filtered
    information: Array
    value: float
    gradient: Array
    matrix: Array


class InnovationsFit:
    """Maximises the likelihood of the engine that `engine()` returns, from the best of several vectors.

    `others` are vectors that the stage may begin from beside the one it gets.
    """

    def __init__(
        self,
        name: str,
        total: int,
        engine: Callable[[], FilterEngine],
        others: Sequence[Array],
        precision: float | None,
    ) -> None:
        self.name, self.total, self._make = name, total, engine
        self.others, self.precision = others, precision
        self._engine: FilterEngine | None = None

    @property
    def engine(self) -> FilterEngine:
        """The filter of the data."""
        if self._engine is None:
            self._engine = self._make()
        return self._engine

    # ---------------------------------------------------------------- the stage
    def begin(self, theta: Array) -> State:
        """The vectors to begin from, the best first: those given, with several sizes of noises and disturbances."""
        first, engine, starts = self.engine.noise.first(), self.engine, list[Array]()
        for each in (theta, *self.others):
            for factor, shift in SCALES:
                start = np.concatenate([self._scaled(each, factor), first + shift])
                # A warm start that moved no constant leaves the declared ones, whose iterations would be the same.
                if not any(np.allclose(start, one, rtol=1e-6, atol=1e-6) for one in starts):
                    starts.append(start)
        values = np.array([engine.value(each) for each in starts])
        # Vectors without a solution are no starts; if none has one, the first iteration says where it ends.
        order = np.argsort(values, kind="stable")[: max(min(STARTS, int(np.isfinite(values).sum())), 1)]
        return self._begun(starts[order[0]]) | {
            "waiting": np.array([starts[i] for i in order[1:]]).reshape(-1, len(starts[0])),
            "best": np.zeros(0),
            "best_value": np.array(np.inf),
            "left": np.array(float(ROUND if len(order) > 1 else self.total)),
        }

    def going_on(self, vector: Array) -> State:
        """The state at a vector of the likelihood as the only one to begin from."""
        alone = {"waiting": np.zeros((0, len(vector))), "best": np.zeros(0), "best_value": np.array(np.inf)}
        tried = {"smaller": np.array(1.0), "inner": np.zeros(0)}
        return self._begun(vector) | alone | {"left": np.array(float(self.total))} | tried

    def _begun(self, vector: Array) -> State:
        """The state at a vector of the likelihood."""
        theta, log_sd = self.engine.layout.split(vector)
        weights = theta[: self.engine.parameters.n_weights]
        ridge = (
            FIRST * len(weights) / max(float(weights @ weights), 1e-12) if self.precision is None else self.precision
        )
        return {
            "theta": theta,
            "log_sd": log_sd,
            "damping": np.array(1e-2),
            "ridge": np.array(ridge if len(weights) else 0.0),
            "small": np.array(0.0),
            "settled": np.array(0.0),
            "pinned": np.array(0.0),
            **_stored(Restricted.none(self.engine.layout.size)),
            **dict.fromkeys(MOMENTS, np.zeros((0, 0))),
        }

    def _scaled(self, theta: Array, factor: float) -> Array:
        """The vector with learned constants that occur only in disturbances multiplied by a factor."""
        parameters, model = self.engine.parameters, self.engine.problem.model
        out = theta.copy()
        if factor == 1.0:
            return out
        with torch.no_grad():
            values = parameters.constants(torch.from_numpy(theta)).numpy()[0, len(model.constants) :]
        for entry in self._sizes[self._sizes < len(theta)]:
            index = parameters.shared[entry - parameters.n_weights]
            moved = parameters.bijections((index,)).from_natural(np.array([factor * values[index]]))
            out[entry] = moved[0]
        return out

    @cached_property
    def _sizes(self) -> Integers:
        """The entries that are sizes of disturbances and noises."""
        return sizes(self.engine)

    def step(self, state: State, iteration: int) -> Outcome:
        """One iteration; after `ROUND` of them the next vector, and after the last one the best goes on."""
        outcome = self._compared(state, iteration) if f"{CONSTANT}theta" in state else self._stepped(state, iteration)
        if iteration + 1 < self.total:
            return outcome
        return replace(outcome, unfinished=self._unfinished(outcome.state))

    def _unfinished(self, state: State) -> ComputationError | None:
        """What is to be said where the last of all iterations ended before a maximum."""
        vector, ridge = np.concatenate([state["theta"], state["log_sd"]]), scalar(state, "ridge")
        system = self._system(vector, ridge, _moments(state))
        if scalar(state, "settled"):
            system = replace(system, gradient=system.gradient + self._restricted(state, system, vector, ridge).slope)
        move = self._move(system, 0.0, vector)
        fall = -float(system.gradient @ move + 0.5 * move @ system.matrix @ move)
        return not_at_maximum(2 * fall, self.total, stuck=False)

    def _stepped(self, state: State, iteration: int) -> Outcome:
        """An iteration from the present start, or from the next where that one fails."""
        try:
            outcome = self._iteration(state, iteration)
        except ComputationError:
            if not len(state["waiting"]) and not len(state["best"]):
                raise
            return self._stepped(self._next(state), iteration)
        left = scalar(state, "left") - 1
        new = {**state, **outcome.state, "left": np.array(left)}
        if not len(state["waiting"]) and not len(state["best"]):
            return self._rested(new, outcome, iteration)
        if left > 0 and not outcome.done:
            return Outcome(new, outcome.loss, False)
        vector = np.concatenate([new["theta"], new["log_sd"]])
        if outcome.loss < scalar(state, "best_value"):
            new |= {"best": vector, "best_value": np.array(outcome.loss)}
        loss = outcome.loss if len(state["waiting"]) else scalar(new, "best_value")
        return Outcome(self._next(new), loss, False)

    def _next(self, state: State) -> State:
        """The state at the next vector that waits, or after the last one at the best."""
        if len(state["waiting"]):
            following = self._begun(state["waiting"][0])
            return {**state, **following, "waiting": state["waiting"][1:], "left": np.array(float(ROUND))}
        return {**state, **self._begun(state["best"]), "best": np.zeros(0), "left": np.array(float(self.total))}

    def _rested(self, state: State, outcome: Outcome, iteration: int) -> Outcome:
        """An iteration of the best start. Where it rests, constants at bounds may be released, and smaller disturbances
        and other values of constants at bounds are tried once; where the fit with unknown functions does, one in which
        these are constants follows, whose state is kept beside that of the fit."""
        onward = (self._released(state) or self._with_smaller(state) or self._inside(state)) if outcome.done else None
        if onward is not None:
            return Outcome(onward, outcome.loss, False)
        weights = self.engine.parameters.n_weights
        if self.precision is not None or not weights:
            return Outcome(state, outcome.loss, outcome.done)
        if not outcome.done and iteration + 1 < (1 - LAST) * self.total:
            return Outcome(state, outcome.loss, False)
        begin = np.concatenate([state["theta"], state["log_sd"]])
        begin[:weights] = 0.0
        constant = {**self._begun(begin), "ridge": np.array(PINNED), "pinned": np.array(1.0)}
        return Outcome({**state, **_prefixed(constant)}, outcome.loss, False)

    def _released(self, state: State) -> State | None:
        """The state with constants inside of bounds at which they were stuck; None if there are none."""
        engine, times = self.engine, float(state.get("released", 0.0))
        vector, ridge = np.concatenate([state["theta"], state["log_sd"]]), scalar(state, "ridge")
        places = np.arange(engine.parameters.n_weights, engine.parameters.n_shared)

        def at(u: Array) -> Array:
            moved = vector.copy()
            moved[places] = u
            return moved

        def value(u: Array) -> float:
            return self._value(at(u), ridge, engine.filtered(at(u), guess=_moments(state)))

        maps = engine.parameters.bijections(engine.parameters.shared)
        u = released(maps, vector[places], value, LOWER) if times < RELEASES else None
        return None if u is None else {**state, **self._begun(at(u)), "released": np.array(times + 1)}

    def _with_smaller(self, state: State) -> State | None:
        """The state where smaller disturbances give a higher likelihood; None if none do, or if they were tried."""
        if "smaller" in state:
            return None
        vector = near_none(self.engine, np.concatenate([state["theta"], state["log_sd"]]))
        return None if vector is None else {**state, **self._begun(vector), "smaller": np.array(1.0)}

    def _inside(self, state: State) -> State | None:
        """The state at a higher maximum where constants are inside that rest at bounds; None if there is none, or if
        they were tried. Where the restricted likelihood leads away to a lower one, sizes stay the likeliest ones."""
        vector, tried = np.concatenate([state["theta"], state["log_sd"]]), "inner" in state
        found = state["inner"] if tried else inner(self.engine, vector)
        if found is None or not len(found):
            return None
        if tried and not higher(self.engine, likeliest(self.engine, found), vector):
            return None
        more: State = {"inner": np.zeros(0), "likeliest": np.array(1.0)} if tried else {"inner": found}
        return {**state, **self._begun(found), **more}

    def _compared(self, state: State, iteration: int) -> Outcome:
        """An iteration of the fit with constant functions; at its end the fit with the smaller criterion is kept."""
        constant = {name.removeprefix(CONSTANT): value for name, value in state.items() if name.startswith(CONSTANT)}
        outcome = self._iteration(constant, iteration)
        constant |= outcome.state
        if not outcome.done and iteration + 1 < self.total:
            return Outcome({**state, **_prefixed(constant)}, outcome.loss, False)
        kept = {name: value for name, value in state.items() if not name.startswith(CONSTANT)}
        if not self._criterion(kept) < self._criterion(constant):
            kept |= constant
        count, vector = max(int(self.engine.problem.seen.sum()), 1), np.concatenate([kept["theta"], kept["log_sd"]])
        said = self._constant() if scalar(kept, "ridge") >= PINNED else ""
        return Outcome(kept, self.engine.filtered(vector, guess=_moments(kept)).value / count, True, said)

    def _constant(self) -> str:
        """What is said where functions are constant."""
        names = " and ".join(f"`{unknown.name}`" for unknown in self.engine.problem.model.unknowns)
        return (
            f"the data do not show how {names} changes: by the corrected information criterion a constant network is "
            "as good; only longer or further trajectories can show more"
        )

    def _criterion(self, state: State) -> float:
        """Hurvich, Simonoff and Tsai's information criterion with the effective number of entries; infinite where there
        are more of these than values."""
        vector = np.concatenate([state["theta"], state["log_sd"]])
        system = self._system(vector, scalar(state, "ridge"), _moments(state))
        if not system.found.finite:
            return float("inf")
        effective = float(np.sum(inverse(system.matrix, self.engine.layout.free, ROUNDING) * system.information))
        left = int(self.engine.problem.seen.sum()) - effective - 1
        return 2 * (system.found.value + effective * (1 + (effective + 1) / left)) if left > 0 else float("inf")

    def _iteration(self, state: State, iteration: int) -> Outcome:
        """One iteration: the information, and as many dampings as are needed for a higher likelihood."""
        engine, vector = self.engine, np.concatenate([state["theta"], state["log_sd"]])
        damping, ridge, settled = (scalar(state, name) for name in ("damping", "ridge", "settled"))
        system = self._system(vector, ridge, _moments(state))
        if not (system.found.finite and np.isfinite(system.matrix).all()):
            raise not_finite(engine, system.found, self.name)
        term = self._restricted(state, system, vector, ridge) if settled else _restored(state)
        system = replace(system, gradient=system.gradient + term.slope)
        count = max(int(engine.problem.seen.sum()), 1)
        for _ in range(ATTEMPTS):
            move = self._move(system, damping, vector)
            predicted = -float(system.gradient @ move + 0.5 * move @ system.matrix @ move)
            trial = vector + move
            found = engine.filtered(trial, guess=system.found.guess)
            gain = system.value - self._value(trial, ridge, found) - float(term.slope @ move)
            if gain > 0 or abs(predicted) < SMALL:
                break
            damping *= 4.0
        if not gain > 0:
            # The likelihood rests, unless shorter steps are left; the restricted one is yet to be maximised.
            rests = settled > 0 and (abs(predicted) < SMALL or damping > STRONG)
            new: State = {"settled": np.array(1.0)}
            if settled and not rests:
                new["damping"] = np.array(damping)
            return Outcome(state | new, system.found.value / count, rests)
        theta, log_sd = engine.layout.split(trial)
        estimated = self.precision is None and engine.parameters.n_weights and not scalar(state, "pinned")
        if estimated and gain < SETTLED:
            ridge = self._evidence(system, trial, ridge)
        rests = (
            settled > 0
            and damping <= USUAL
            and min(gain, predicted) < SMALL * max(1.0, 1e-3 * abs(system.value - gain))
        )
        small = scalar(state, "small") + 1 if rests else 0.0
        faster = 0.2 if gain / max(predicted, 1e-300) > 0.5 else 2.0
        new = {
            "theta": theta,
            "log_sd": log_sd,
            "damping": np.array(float(np.clip(damping * faster, 1e-9, 1e6))),
            "ridge": np.array(ridge),
            "small": np.array(small),
            "settled": np.array(float(settled > 0 or gain < SETTLED)),
            **_stored(replace(term, age=term.age + 1)),
            **dict(zip(MOMENTS, found.guess, strict=True)),
        }
        return Outcome(new, found.value / count, small >= 2)

    def _restricted(self, state: State, system: _System, vector: Array, ridge: float) -> Restricted:
        """The restricted likelihood's term at a vector: that of the state while it fits, or where it is left out."""
        engine, term = self.engine, _restored(state)
        at = place_of(engine, self._sizes, vector, ridge)
        if "likeliest" in state or term.fits(at):
            return term
        found, known, matrix = system.found, system.information, system.matrix
        return Restricted(slope(engine, self._sizes, vector, found, known, matrix), at, 0)

    def _move(self, system: _System, damping: float, vector: Array) -> Array:
        """The damped step within a box: no entry longer than allowed, and no noise below the least.

        Entries that would leave the box go to its side, and the others are solved again with these fixed.
        """
        size, least = self.engine.parameters.size, self.engine.noise.least()
        matrix = system.matrix + np.diag(damping * np.maximum(np.diag(system.matrix), FLAT))
        limit = np.full(len(vector), LONGEST)
        limit[: self.engine.parameters.n_weights] = limit[size:] = 2.0
        low, high = -limit, limit
        low[size:] = np.maximum(low[size:], least - vector[size:])
        move, inside = np.zeros(len(vector)), self.engine.layout.free > 0
        while inside.any():
            given = -system.gradient - matrix[:, ~inside] @ move[~inside]
            scale = 1 / np.sqrt(np.maximum(np.diag(matrix)[inside], FLAT))
            block = matrix[np.ix_(inside, inside)] * np.outer(scale, scale)
            move[inside] = scale * np.linalg.lstsq(block, scale * given[inside], rcond=1e-13)[0]
            beyond = inside & ((move < low) | (move > high))
            move = np.clip(move, low, high)
            if not beyond.any():
                break
            inside &= ~beyond
        return move

    # ---------------------------------------------------------------- the objective
    def _priors(self) -> Priors:
        return Priors.of_likelihood(self.engine.problem, self.engine.parameters)

    def _value(self, vector: Array, ridge: float, found: Filtered) -> float:
        theta, _ = self.engine.layout.split(vector)
        weights = theta[: self.engine.parameters.n_weights]
        if not found.finite:
            return float("inf")
        return found.value + 0.5 * ridge * float(weights @ weights) + self._priors().penalty(theta)

    def _system(self, vector: Array, ridge: float, guess: Guess | None = None) -> _System:
        engine = self.engine
        found = engine.filtered(vector, guess=guess)
        information = engine.information(vector, found)
        theta, _ = engine.layout.split(vector)
        gradient, matrix = information.gradient.copy(), information.matrix.copy()
        weights = np.arange(engine.parameters.n_weights)
        gradient[weights] += ridge * theta[weights]
        matrix[weights, weights] += ridge
        priors = self._priors()
        if len(priors):
            gradient[: len(theta)] += priors.gradient(theta)
            slopes = np.zeros((len(priors), len(vector)))
            slopes[np.arange(len(priors)), priors.column] = priors.slopes(theta)
            matrix += slopes.T @ slopes
        return _System(found, information.matrix, self._value(vector, ridge, found), gradient, matrix)

    def _evidence(self, system: _System, vector: Array, ridge: float) -> float:
        """The precision of the weights' prior by the evidence, averaged with the present one (in logarithms)."""
        count = self.engine.parameters.n_weights
        weights, covariance = vector[:count], inverse(system.matrix, self.engine.layout.free, ROUNDING)
        effective = float(np.clip(count - ridge * np.trace(covariance[:count, :count]), 1.0, count))
        return float(np.sqrt(ridge * effective / max(float(weights @ weights), 1e-12)))

    # ---------------------------------------------------------------- what is known at the end
    def estimated(self, state: State) -> Estimated:
        """The learned noises of the channels."""
        noise = np.full(len(self.engine.problem.model.channels), np.nan)
        noise[self.engine.noise.learned] = np.exp(state["log_sd"])
        return Estimated(noise, np.ones(len(noise)))

    def certainty(self, state: State) -> Certainty:
        """Standard deviations and correlations of constants at a state; see `certainty_of`."""
        vector = np.concatenate([state["theta"], state["log_sd"]])
        system = self._system(vector, scalar(state, "ridge"))
        if not system.found.finite:
            return Certainty.unknown(self.engine.parameters)
        return certainty_of(self.engine, vector, system.found, system.matrix, system.gradient)


def _prefixed(state: State) -> State:
    """The state of the fit with constant functions as it is kept beside that of the fit."""
    return {f"{CONSTANT}{name}": value for name, value in state.items()}


def _stored(term: Restricted) -> State:
    """The restricted likelihood's term as it is kept in a state."""
    return {"slope": term.slope, "slope_at": term.at, "slope_age": np.array(float(term.age))}


def _restored(state: State) -> Restricted:
    """The term that is kept in a state."""
    return Restricted(state["slope"], state["slope_at"], int(scalar(state, "slope_age")))


def _moments(state: State) -> Guess | None:
    """The filter's moments and steps at the vector of a state, if they are known."""
    a, b, c, d, e = (state[name] for name in MOMENTS)
    return (a, b, c, d, e) if len(a) else None
