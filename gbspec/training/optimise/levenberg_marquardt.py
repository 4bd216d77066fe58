"""The Levenberg-Marquardt stage: robust, damped, optionally regularised, resumable after every iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, Linearised, linearise, residual_vector
from gbspec.training.optimise.certainty import Certainty
from gbspec.training.optimise.kinks import held_at_kinks, without_held
from gbspec.training.optimise.normal_equations import (
    NormalEquations,
    huber,
    huber_limit,
    huber_weights,
    of_estimates,
)
from gbspec.training.optimise.priors import Priors, widest
from gbspec.training.optimise.released import released
from gbspec.training.optimise.stage import Outcome, State, require_finite, scalar
from gbspec.training.problem import Parameters, Problem, mean_loss

ON_THE_WAY = 0.1
"""The largest limit of Huber's function on the way to a fit: an event at a wrong time makes few large residuals."""
ATTEMPTS = 10
"""Number of dampings tried in one iteration before the stage gives up."""
LESS, MORE, GOOD = 0.2, 2.0, 0.9
"""Factors from one damping to the next, and the ratio of actual to predicted decrease above which less damping is
tried."""
LEAST = 1e-12
"""The smallest damping."""
DIFFERENCE, BEND = 0.1, 0.75
"""The fraction of a step used to estimate its curvature, and the largest correction relative to the step."""
CORRECTIONS, WORTHWHILE = 8, 0.02
"""Largest number of corrections of a step, and the relative decrease of the objective that each must achieve."""
LOWER = 2e-3
"""A constant is released from its bound if that lowers the objective by more than this many times the mean loss, which
is that part of -2 log likelihood."""
LARGEST_RIDGE = 1e100
"""Where data show no function the weights go to zero, and the ridge of the evidence with their inverse square: it is
finite, since an infinite one times the zeros of what it does not concern is no number."""
EVIDENCE_UPDATES = 6
"""How often the ridge is estimated again from one linearisation."""
WEAK = 1e-2
"""Prior precision assumed for entries without a prior, relative to the noise, in the count of degrees of freedom."""


@dataclass(frozen=True)
class LevenbergOptions:
    """Settings of a stage and its criteria of termination.

    `robust`: Huber's function, else least squares; `most`: its largest limit, in standard deviations of the data;
    `tolerance`: relative decrease below which (twice in a row) the stage ends; `enough`: mean loss below which it ends
    at once, or a function of a vector and its residuals that returns this loss; `damping`: the initial one; `ridge`:
    precision of the weights' prior in units of squared residuals; `evidence`: re-estimate the ridge from the data after
    each iteration; `spread`: with `evidence`, also a move of the predictions below this many of their standard
    deviations (root mean square, twice in a row) ends it; `kinks`: where times of events rest at kinks, the rest is
    fitted with these held.
    """

    robust: bool = True
    most: float = ON_THE_WAY
    tolerance: float = 1e-3
    enough: float | Callable[[Array, Array], float] = 0.0
    damping: float = 1.0
    ridge: float = 0.0
    evidence: bool = False
    spread: float = 0.0
    kinks: bool = False


class LevenbergMarquardt:
    """Minimises the objective of the engine that `engine_at(iteration)` returns (always the same one unless sub-steps
    are random)."""

    def __init__(
        self,
        name: str,
        total: int,
        engine_at: Callable[[int], Engine],
        options: LevenbergOptions,
    ) -> None:
        self.name, self.total, self.engine_at = name, total, engine_at
        self.options = options

    def begin(self, theta: Array) -> State:
        """The initial state: the vector, damping, ridge, and the number of successive small decreases."""
        return {
            "theta": theta,
            "damping": np.array(self.options.damping),
            "ridge": np.array(self.options.ridge),
            "small": np.array(0.0),
        }

    def threshold(self, residuals: Array) -> float:
        """Huber's threshold for these residuals."""
        return huber_limit(residuals, self.options.most) if self.options.robust else float("inf")

    def step(self, state: State, iteration: int) -> Outcome:
        """One iteration: a Jacobian, and as many dampings as are needed for a decrease."""
        engine, theta = self.engine_at(iteration), state["theta"]
        damping, ridge, small = (scalar(state, name) for name in ("damping", "ridge", "small"))
        system = linearise(engine, theta)
        require_finite(engine, theta, system.residuals.numpy(), self.name)
        delta = self.threshold(engine.problem.of_noise(system.residuals.numpy()))
        fit = _Fit(engine, system, theta, delta, ridge, state.get("held"))
        found = _searched(fit, damping)
        if not found.after.value < fit.start.value:
            kept = state | {"damping": np.array(found.damping), "small": np.array(2.0)}
            return self._ended(Outcome(kept, mean_loss(fit.measured(fit.start)), True), fit)
        before, after, trial = fit.start.value, found.after, theta + found.move
        rests = (before - after.value) < self.options.tolerance * max(before, 1e-300)
        if self.options.evidence:
            measured = fit.measured(fit.start)
            # The same random vectors in each iteration, without which the ridge would never settle.
            ridge, used = evidence(engine.problem, fit.equations, measured, fit.delta, trial, ridge, 0)
            uncertain = used * noise_variance(engine.problem, measured, fit.delta, used)
            rests = rests or fit.moved(after) < self.options.spread**2 * uncertain
        # The better the linear model predicted the decrease, the less damping is needed (Nielsen 1999).
        damping = found.damping * float(np.clip(1 - (2 * found.gain - 1) ** 3, 0.2, 2.0))
        small = small + 1 if rests else 0.0
        new: State = state | {
            "theta": trial,
            "damping": np.array(max(damping, LEAST)),
            "ridge": np.array(ridge),
            "small": np.array(small),
        }
        measured = fit.measured(after)
        if self.close(trial, measured):
            return Outcome(new, mean_loss(measured), True)
        reached = Outcome(new, mean_loss(measured), small >= 2)
        return self._ended(reached, fit) if reached.done else reached

    def _ended(self, outcome: Outcome, fit: _Fit) -> Outcome:
        """The last iteration, or one after which constants are off bounds where they were stuck, or held at kinks."""
        theta, parameters = outcome.state["theta"], fit.parameters

        def at(u: Array) -> Array:
            moved: Array = theta.copy()
            moved[parameters.places] = u
            return moved

        def value(u: Array) -> float:
            return fit.solved(at(u) - fit.theta).value

        least = LOWER * outcome.loss
        u = released(parameters.bijections(parameters.shared), theta[parameters.places], value, least)
        changed: State = {"theta": at(u)} if u is not None else {}
        if not changed and self.options.kinks:
            changed = held_at_kinks(outcome.state, parameters, lambda there: fit.solved(there - fit.theta).value)
        begun: State = {"damping": np.array(self.options.damping), "small": np.array(0.0)}
        return Outcome(outcome.state | changed | begun, outcome.loss, False) if changed else outcome

    def close(self, theta: Array, residuals: Array) -> bool:
        """Whether the mean loss of these residuals of a vector is so small that the stage ends."""
        enough = self.options.enough
        return mean_loss(residuals) < (enough(theta, residuals) if callable(enough) else enough)

    def certainty(self, state: State) -> Certainty:
        """Standard deviations from the curvature at a converged state; unknown if the equations are numerically
        singular.

        The covariance (Gauss-Newton, Laplace) is the noise variance times the inverse of the normal matrix, priors and
        ridge included. The change of a constant in the next undamped step is added in quadrature to its standard
        deviation, which is NaN if the change is larger than the deviation: the stage has not converged.
        """
        try:
            return self._certainty(state)
        except np.linalg.LinAlgError:  # for example if all residuals are zero
            return Certainty.unknown(self.engine_at(0).parameters)

    def _certainty(self, state: State) -> Certainty:
        engine, theta, ridge = self.engine_at(0), state["theta"], scalar(state, "ridge")
        parameters = engine.parameters
        system = linearise(engine, theta)
        residuals = system.residuals.numpy()
        if not np.isfinite(residuals).all():
            return Certainty.unknown(parameters)
        delta = self.threshold(engine.problem.of_noise(residuals))
        fit = _Fit(engine, system, theta, delta, ridge)
        equations = fit.equations
        weak = WEAK * max(float(np.mean(residuals**2)), 1e-300)
        ahead, count = fit.step(weak), len(parameters.shared)
        if "held" in state:
            ahead = _Fit(engine, linearise(engine, theta), theta, delta, ridge, state["held"]).step(weak)
        out, inverse = np.zeros(count), np.zeros((count, count))
        for i in range(count):
            unit = np.zeros(parameters.size)
            unit[parameters.n_weights + i] = 1.0
            inverse[i] = equations.invert(unit, weak)[parameters.n_weights : parameters.n_shared]
        local = np.full((parameters.trajectories, parameters.n_local), np.nan)
        if parameters.own or not parameters.n_weights:  # what takes a solution for each entry, and nothing else needs
            local = equations.local_variances(weak)
        freedom = _used(equations, np.diag(inverse), local, weak)
        variance = noise_variance(engine.problem, residuals, delta, freedom)
        variance *= of_estimates(residuals, fit.limit, freedom)
        slopes = parameters.bijections(parameters.shared).derivative(theta[parameters.places])
        most = widest(parameters, theta)
        for i, slope in enumerate(slopes):
            own, move = np.sqrt(max(inverse[i, i], 0.0) * variance), float(ahead[parameters.n_weights + i])
            out[i] = min(abs(float(slope)) * np.hypot(own, move), most[i]) if abs(move) <= own else np.nan
        roots = np.sqrt(np.maximum(np.diag(inverse), 1e-300)) * np.where(slopes < 0, -1.0, 1.0)
        own = _own_deviations(parameters, theta, local, variance, ahead)
        return Certainty(out, 0.5 * (inverse + inverse.T) / np.outer(roots, roots), freedom, own)


def _used(equations: NormalEquations, shared: Array, local: Array, weak: float) -> float:
    """The degrees of freedom that a fit has used, tr(J (J^T J + D)^-1 J^T): without a network the number of entries
    less D times the trace of the inverse, of which `shared` [k] and `local` [N, n] are the diagonal. An estimate of
    the first trace may be one too high or too low, which matters where values are few."""
    entries = np.concatenate([shared, local.ravel()])
    if equations.parameters.n_weights or not np.isfinite(entries).all():
        return equations.degrees_of_freedom(weak, 0)
    return float(np.sum(1 - weak * entries))


def _own_deviations(parameters: Parameters, theta: Array, local: Array, variance: float, ahead: Array) -> Array:
    """Standard deviations [N, k] of the constants per trajectory, by the rule for shared ones, from the diagonal
    `local` of the inverse."""
    if not parameters.own:
        return np.zeros((parameters.trajectories, 0))
    count = len(parameters.own)
    blocks, moves = (v[parameters.n_shared :].reshape(-1, parameters.n_local)[:, :count] for v in (theta, ahead))
    own = np.sqrt(np.maximum(local[:, :count], 0.0) * variance)
    slopes = parameters.bijections(parameters.own).derivative(blocks)
    return np.where(np.abs(moves) <= own, np.abs(slopes) * np.hypot(own, moves), np.nan)


@dataclass(frozen=True)
class _Solved:
    """All rows of residuals at a vector, and the value of the objective."""

    residuals: Array
    value: float


class _Fit:
    """One linearisation: the residuals of the `count` measured values, followed by the rows of the priors.

    Where Huber's function reduces the weights of measurements, priors are reduced by the average of these weights.
    """

    def __init__(
        self, engine: Engine, system: Linearised, theta: Array, delta: float, ridge: float, held: Array | None = None
    ) -> None:
        measured = system.residuals.numpy()
        self.limit = engine.problem.limit(delta)
        weights = huber_weights(measured, self.limit)
        self.engine, self.parameters, self.count = engine, engine.parameters, len(measured)
        self.theta, self.delta, self.ridge = theta, delta, ridge
        self.priors = Priors.of(engine.problem, engine.parameters, measured)
        self.balance = float(weights.mean()) if len(weights) else 1.0
        rows = without_held(self.priors.with_rows(system, theta), engine.parameters, held)
        residuals: Array = rows.residuals.numpy()
        weights = np.concatenate([weights, np.full(len(self.priors), self.balance)])
        self.equations = NormalEquations(rows, engine.parameters, weights, ridge, theta)
        self.start = self._with_value(residuals, theta)

    def solved(self, move: Array) -> _Solved:
        """All rows at the vector displaced by `move`."""
        at = self.theta + move
        rows = [residual_vector(self.engine, at), self.priors.rows(at)]
        return self._with_value(np.concatenate(rows), at)

    def _with_value(self, residuals: Array, at: Array) -> _Solved:
        priors = residuals[self.count :]
        with np.errstate(over="ignore", invalid="ignore"):  # diverging corrections
            penalty = self.ridge * float(self.equations.penalised @ at**2) + self.balance * float(priors @ priors)
        return _Solved(residuals, huber(residuals[: self.count], self.limit) + 0.5 * penalty)

    def step(self, damping: float) -> Array:
        """The damped step; NaN, which is never accepted, if the equations are numerically singular."""
        return self._found(lambda: self.equations.step(damping))

    def correction(self, target: Array, damping: float) -> Array:
        """The damped least-squares step that cancels the change `target` of all (weighted) rows; NaN as above."""
        return self._found(lambda: self.equations.respond(target, damping))

    def _found(self, solve: Callable[[], Array]) -> Array:
        try:
            return solve()
        except np.linalg.LinAlgError:
            return np.full(self.parameters.size, np.nan)

    def moved(self, solved: _Solved) -> float:
        """The sum of squares by which predictions of measured values differ from those of the start, weighed alike."""
        change = self.equations.root[: self.count] * (self.measured(solved) - self.measured(self.start))
        return float(change @ change)

    def measured(self, solved: _Solved) -> Array:
        """The residuals of measured values."""
        return solved.residuals[: self.count]


@dataclass(frozen=True)
class _Trial:
    """A damping, its displacement, the rows there, and the ratio of actual to predicted decrease (0: no decrease)."""

    damping: float
    move: Array
    after: _Solved
    gain: float

    @classmethod
    def of(cls, fit: _Fit, damping: float) -> _Trial:
        """Tries a damping."""
        step = fit.step(damping)
        move, after = _followed(fit, step, damping)
        if not after.value < fit.start.value:
            return cls(damping, move, after, 0.0)
        predicted = fit.equations.predicted_decrease(step)  # at convergence only rounding error, of either sign
        gain = min((fit.start.value - after.value) / predicted, 1.0) if predicted > 0 else 1.0
        return cls(damping, move, after, gain)


def _searched(fit: _Fit, damping: float) -> _Trial:
    """The best of a few dampings, since a Jacobian costs more than several trials.

    The damping is increased from the current one, by growing factors, until the objective decreases. If the first trial
    succeeds it is reduced as long as the decrease is as predicted, but not under a ridge: its strength is estimated
    only step by step, so that a long step would fit the noise (hare and lynx, predicted by fits of the other years:
    errors of logarithms 0.330 instead of 0.303).
    """
    best = _Trial.of(fit, damping)
    factor = MORE
    for _ in range(ATTEMPTS - 1):
        if best.gain > 0:
            break
        best = _Trial.of(fit, best.damping * factor)
        factor *= MORE
    while not fit.ridge and best.gain > GOOD and factor == MORE and best.damping > LEAST:
        trial = _Trial.of(fit, best.damping * LESS)
        if not trial.after.value < best.after.value:
            break
        best = trial
    return best


def _followed(fit: _Fit, step: Array, damping: float) -> tuple[Array, _Solved]:
    """The displacement along the curved path that begins with `step`, and the rows there.

    A minimum lies in a narrow curved valley of the objective. On a straight step of useful length the residuals deviate
    from the linear model by many times their size. Corrections with the present equations remove nearly all of this:
    first half the geodesic acceleration, then chord steps towards the predicted residuals. Each costs one solution, and
    allows a half to a quarter of the damping before the next Jacobian.
    """
    best = step, fit.solved(step)
    bend = _bend(fit, step, damping)
    if bend is None:
        return best
    equations, root = fit.equations, fit.equations.root
    predicted = root * fit.start.residuals + equations.times(step)
    move = step + bend
    for _ in range(1 + CORRECTIONS):
        there = fit.solved(move)
        gained = best[1].value - there.value
        if not gained > 0:
            break
        best = move, there
        if gained < WORTHWHILE * min(there.value, fit.start.value):
            break
        move = move + fit.correction(root * there.residuals - predicted, damping)
    return best


def _bend(fit: _Fit, step: Array, damping: float) -> Array | None:
    """Half the geodesic acceleration along a step (Transtrum and Sethna 2012); None if it is too large.

    The second derivative of the residuals along the step is approximated by a finite difference.
    """
    ahead = fit.solved(DIFFERENCE * step).residuals
    if not np.isfinite(ahead).all():
        return None
    equations = fit.equations
    second = 2 / DIFFERENCE * (equations.root * (ahead - fit.start.residuals) / DIFFERENCE - equations.times(step))
    bend = 0.5 * fit.correction(second, damping)
    with np.errstate(over="ignore"):
        small = 2 * float(np.linalg.norm(bend)) <= BEND * float(np.linalg.norm(step))
    return bend if small else None


def moved(engine: Engine, theta: Array, change: Array) -> float:
    """The largest move of a shared constant, in its standard deviations, if the residuals [m] change by `change`.

    By a Gauss-Newton step from `theta`, with the weights' prior of the evidence there; 0 if it is not known.
    """
    system = linearise(engine, theta)
    residuals = system.residuals.numpy().copy()
    if not np.isfinite(residuals).all():
        return 0.0
    delta = huber_limit(engine.problem.of_noise(residuals))
    fit, parameters = _Fit(engine, system, theta, delta, 0.0), engine.parameters
    equations, weak = fit.equations, WEAK * max(float(np.mean(residuals**2)), 1e-300)
    try:
        for number in range(EVIDENCE_UPDATES):
            equations.ridge, _ = evidence(engine.problem, equations, residuals, delta, theta, equations.ridge, number)
        freedom = equations.degrees_of_freedom(weak, 0)
        target = equations.root * np.concatenate([change, np.zeros(len(equations.root) - len(change))])
        move, worst = equations.respond(target, weak), 0.0
        for place in range(parameters.n_weights, parameters.n_shared):
            unit = np.zeros(parameters.size)
            unit[place] = 1.0
            variance = equations.invert(unit, weak)[place] * noise_variance(engine.problem, residuals, delta, freedom)
            worst = max(worst, abs(float(move[place])) / max(float(variance), 1e-300) ** 0.5)
    except np.linalg.LinAlgError:
        return 0.0
    return worst


def noise_variance(problem: Problem, residuals: Array, delta: float, freedom: float) -> float:
    """Variance of residuals and of replicates about their averages, corrected for the degrees of freedom that the fit
    used."""
    squares, counts = problem.noise_terms(residuals)
    scatter, more = (float(part.sum()) for part in problem.replicates)
    weights, count = huber_weights(residuals, problem.limit(delta)), float(counts.sum())
    return (float(np.sum(weights * squares)) + scatter) / (max(count - freedom, 0.1 * count, 1.0) + more)


def evidence(
    problem: Problem,
    equations: NormalEquations,
    residuals: Array,
    delta: float,
    theta: Array,
    ridge: float,
    seed: int,
) -> tuple[float, float]:
    """The ridge that maximises the evidence at the present linearisation (MacKay 1992), averaged with the present one
    (in logarithms), and the degrees of freedom that the fit has used (0 where they are not known).

    With gamma effective weights the prior's precision is gamma / |w|^2; the noise variance is that of the residuals,
    corrected for all used degrees of freedom. The ridge is the product of the two.
    """
    parameters = equations.parameters
    weights = theta[: parameters.n_weights]
    size = float(weights @ weights)
    if not len(weights) or size == 0.0:
        return ridge, 0.0
    scale = max(float(np.mean(residuals**2)), 1e-300)
    try:
        freedom = equations.degrees_of_freedom(WEAK * scale, seed)
    except np.linalg.LinAlgError:  # numerically singular: the damping is too small for an estimate
        return ridge, 0.0
    unpenalised = len(parameters.shared) + float(parameters.free[parameters.n_shared :].sum())
    effective = max(freedom - unpenalised, 1.0)
    target = min(noise_variance(problem, residuals, delta, freedom) * effective / size, LARGEST_RIDGE)
    return target if ridge <= 0 else float(np.sqrt(ridge * target)), freedom
