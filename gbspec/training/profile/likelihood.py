"""The profile likelihood of a learned constant: how well all other parameters can compensate for a change of it.

The constant is fixed at successive values, outwards from its estimate, and the weights, the other constants and the
initial states are refitted each time (Raue et al. 2009, Bioinformatics 25, 1923). Whole solutions from the initial
states are fitted. With Phi the penalised half sum of squares, D = 2 (Phi - min Phi) / sigma^2 is the
deviance; below the 90 % point of F(1, n), n being the degrees of freedom of the residuals from which sigma is known
(2.706, that of chi-squared, for many), a value is within the interval. Where residuals are autocorrelated, the
threshold is higher by the square of the factor that widens the intervals of the fit.

The weights' prior is centered at the weights of the run, with the precision that the evidence gives there. A network
has far more weights than the data determine, and whole solutions are nonlinear in the others: if the fit does not
converge under that precision, the precision is raised until it does, and the resulting decrease of the interval is
reported. Each fit starts from the prediction of the linearised fit, and every fit is stored in the run directory for
reuse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.runs import Run, quantile
from gbspec.training.engines import residual_vector
from gbspec.training.optimise import (
    Anchor,
    NormalEquations,
    Penalised,
    Rest,
    evidence,
    minimise,
    noise_variance,
    require_finite,
)
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Bijection, Bijections, Parameters, Problem, typical
from gbspec.training.profile.agreement import narrowing
from gbspec.training.profile.assembled import Basis, Fitted, Report, profile_from
from gbspec.training.profile.marginal import profile_of_likelihood
from gbspec.training.profile.places import Beside
from gbspec.training.profile.possible import check
from gbspec.training.profile.refits import AGAIN, WEAK, Follower, Refit, Refits
from gbspec.training.profile.result import Profile
from gbspec.training.profile.said import said_of_estimate
from gbspec.training.profile.store import Kept
from gbspec.training.recipe import FIRST_RIDGE, Context, build_context
from gbspec.training.runs import agreed, at_bounds, widening

INSIDE = 1e-3
"""Fits begin with constants off their bounds by this share of the range."""
TIGHTER, MOST_TIGHTER = 10.0, 6
"""The factor by which the precision of the weights' prior is raised, and the largest number of times."""
ROUNDS = 8
"""Iterations of the evidence at one linearisation."""
CLEAN = 1e-6
"""The smallest standard deviation of the noise used for the deviance, in standard deviations of the data."""


def profile_constant(
    run: Run,
    name: str,
    trajectories: Trajectories,
    *,
    member: int | None = None,
    points: int = 6,
    iterations: int = 60,
    progress: Report | None = None,
) -> Profile:
    """The profile of a constant that all trajectories share, at most `points` values to either side.

    Raises UserError (GB858) if there is no such constant, ComputationError if the fit cannot be started.
    """
    check(run.model, name)
    number = run.best if member is None else member
    if run.model.marginal:
        return profile_of_likelihood(run, name, trajectories, number, points, iterations, progress)
    profiler = _Profiler(run, name, trajectories, number, iterations)
    try:
        best = profiler.estimate()
    except np.linalg.LinAlgError as error:
        what = f"the profile of `{name}` cannot be started: derivatives at the estimate are not finite"
        raise ComputationError(what, remedy="train again with a smaller `--max-step`") from error
    return profile_from(run, number, profiler, best, points, progress, profiler.narrowed)


class _Profiler:
    """Fits with the constant free, then fixed, all based on one linearisation."""

    def __init__(self, run: Run, name: str, trajectories: Trajectories, member: int, iterations: int) -> None:
        options = replace(TrainOptions.recorded(run.fit.options, run.path), random_substeps=False)
        info = run.member(member).info
        used = {name: float(v) for name in ("max_step", "tolerance") if isinstance(v := info.get(name), int | float)}
        options = replace(options, **used, switches="on" if info.get("switches") else "off")  # type: ignore[arg-type]  # both options are numbers
        options = agreed(run.fit.backend, run.model, run.module, options)
        self.model, self.name, self.iterations = run.model, name, iterations
        self.weights: dict[str, Array] = run.member(member).weights
        seed, labels = options.seed + member, info.get("labels")
        self.free = build_context(run.model, run.module, trajectories, options, seed)
        if labels is not None and labels != list(self.free.packed().labels):  # an older version split by the seed
            self.free = build_context(run.model, run.module, trajectories, replace(options, seed=seed), seed)
        record = next((one for one in run.fit.members if one.member == member), None)
        self.free.estimated = None if record is None else record.estimated(run.model)
        self.widening = 1.0 if record is None else widening(record.channels or {})
        self.threshold = (quantile(None if record is None else record.freedom) * self.widening) ** 2
        self.parameters = self.free.parameters(self._fixed(), released=self._moved_measured_starts())
        self.place = [run.model.learnables[i].name for i in self.parameters.shared].index(name)
        self.column = self.parameters.n_weights + self.place
        self.ended = {one for one, _ in at_bounds(run.model, self._known())}
        self.begin = self._vector(self.parameters, self.free)
        self.kept = Kept.of(run, member, name, trajectories)
        self.notes: list[str] = []
        self.variance, self.deviation, self.narrowed = 1.0, 0.0, 0.0

    def estimate(self) -> Fitted:
        """The fit with all parameters free; sets the noise, the prior, the linear path and the basis of later fits."""
        theta, parameters = self.begin, self.parameters
        engine = self.free.engine(parameters, 0.0)
        residuals = residual_vector(engine, theta)
        require_finite(engine, theta, residuals, "profile")
        noise = max(typical(engine.problem.of_noise(residuals)), CLEAN)
        self.target = self._penalised(FIRST_RIDGE * max(noise, 1e-2) ** 2 if parameters.n_weights else 0.0, noise**2)
        equations = self.target.equations(theta)
        freedom = self._freedom(engine.problem, equations, residuals)
        self.variance = max(noise_variance(engine.problem, residuals, float("inf"), freedom), CLEAN**2)
        first = self.target = self._penalised(equations.ridge, self.variance)
        rest = self._settled(theta)
        residuals = residual_vector(engine, rest.theta)
        self.variance = max(noise_variance(engine.problem, residuals, float("inf"), freedom), CLEAN**2)
        self.target = self._penalised(self.target.ridge, self.variance)
        self.found, self.anchor = rest.theta, self._anchor(rest.theta)
        self.refits = Refits(self._at_step, rest, self.anchor, self.column, self._follower())
        self.deviation = math.sqrt(self.anchor.variance * self.variance)
        if self.target.ridge > first.ridge:
            self._compare(first, rest.theta)
        noise = math.sqrt(self.variance)
        bounds = Bijection.of(self.model.learnables[self.parameters.shared[self.place]])
        self.basis = Basis(self.name, self.column, self.threshold, bounds, self.deviation)
        self.basis.unit, self.basis.noise = self.variance / 2, noise
        begun = self._fitted(Refit(rest))
        beside = self.basis.beside(begun.value)
        if beside is not None:
            self.basis.part = self._part_of_range(begun, beside)
        return begun

    def _part_of_range(self, begun: Fitted, beside: Beside) -> float:
        """The standard deviation of the constant beside a bound, as a part of its range: by slopes a little further
        inside, as those at the bound tell nothing."""
        theta, target = self.found.copy(), self.target

        def inside(entry: float) -> bool:
            theta[self.column] = entry
            return target.value(theta) - begun.objective <= self.threshold * self.basis.unit

        distance = beside.near(inside)
        try:
            deviation = math.sqrt(self._anchor(theta).variance * self.variance)
        except np.linalg.LinAlgError:  # the solution or its derivatives are not finite
            return distance
        return max(beside.part(float(theta[self.column]), deviation), distance / math.sqrt(self.threshold))

    def _freedom(self, problem: Problem, equations: NormalEquations, residuals: Array) -> float:
        """Degrees of freedom that the fit has used; sets the equations' ridge to that of greatest evidence."""
        parameters = self.parameters
        own = len(parameters.shared) + float(parameters.free[parameters.n_shared :].sum())
        if not parameters.n_weights:
            return own
        weak = WEAK * max(float(np.mean(residuals**2)), CLEAN**2)
        for _ in range(ROUNDS):
            given = (residuals, float("inf"), self.begin, equations.ridge, self.free.seed)
            equations.ridge, _ = evidence(problem, equations, *given)
        return equations.degrees_of_freedom(weak, self.free.seed)

    def _settled(self, theta: Array) -> Rest:
        """The fit with all parameters free, under the weakest prior around the run's weights with which it
        converges."""
        enough = self._follower().enough
        ridges = [self.target.ridge * TIGHTER**k for k in range(MOST_TIGHTER if self.parameters.n_weights else 1)]
        for ridge in ridges:
            known = self.kept.find(None, ridge)
            if known is not None:
                self.target = replace(self.target, ridge=ridge)
                return known.rest
        for ridge in ridges:
            self.target = replace(self.target, ridge=ridge)
            anchor = Anchor(self.target.equations(theta), WEAK * self.variance)
            rest = minimise(self.target, anchor, theta, enough, AGAIN)
            if rest.promised <= enough:
                self.kept.add(None, ridge, Refit(rest))
                return rest
        return self._follower().all_free(self.target, theta)

    def _follower(self) -> Follower:
        return Follower(self.variance, self.iterations, bool(self.parameters.n_weights))

    def _compare(self, first: Penalised, theta: Array) -> None:
        """Notes the effect of a tighter prior on the interval, according to the linearised fits."""
        before = self.deviation
        weaker = replace(first, engine=self.target.engine)
        wide = math.sqrt(Anchor(weaker.equations(theta), WEAK * self.variance, (self.column,)).variance * self.variance)
        self.narrowed = 1 - before / wide
        self.notes.append(narrowing(self.target.ridge / first.ridge, self.narrowed))

    def _at_step(self, fraction: float) -> Penalised:
        """The objective at a fraction of the fit's step."""
        return self.target if fraction == 1.0 else self._penalised(self.target.ridge, self.variance, fraction)

    def _penalised(self, ridge: float, variance: float, fraction: float = 1.0) -> Penalised:
        problem = self.free.problem(0.0, fraction)
        problem = replace(problem, scaling=replace(problem.scaling, noise=math.sqrt(variance)))
        return Penalised(
            self.free.choice.engine(problem, self.parameters), ridge, self.begin[: self.parameters.n_weights]
        )

    def _anchor(self, theta: Array) -> Anchor:
        return Anchor(self.target.equations(theta), WEAK * self.variance, (self.column,))

    def held(self, entry: float, neighbour: Fitted) -> Fitted:
        """The fit with the constant's entry of the vector at `entry`, from a neighbour moved along the linear path."""
        known = self.kept.find(entry, self.target.ridge)
        if known is not None:
            return self._fitted(known)
        made = self.refits.held(entry, self._along_path(neighbour.theta, entry), neighbour.fraction)
        if made.exact and self._follower().at_rest(made.rest):
            self.kept.add(entry, self.target.ridge, made)
        return self._fitted(made)

    def _along_path(self, theta: Array, entry: float) -> Array:
        """The vector on the linear path from a vector to where the constant has its entry at `entry`. Constants that
        the fit has at bounds, where the scale of training is bent, move along in their own unit."""
        step = (entry - theta[self.column]) * self.anchor.path
        maps, places = self.parameters.bijections(self.parameters.shared), self.parameters.places
        out = np.asarray(theta + step, dtype=np.float64)
        found = maps.to_natural(torch.from_numpy(theta[places])).numpy()
        bent = [self.model.learnables[i].name in self.ended - {self.name} for i in self.parameters.shared]
        moved = found + maps.derivative(self.found[places]) * step[places]
        inside = np.array([one.inside(float(value), INSIDE) for one, value in zip(maps.each, moved, strict=True)])
        out[places] = np.where(bent, maps.from_natural(inside), out[places])
        return out

    def _fitted(self, made: Refit) -> Fitted:
        rest = made.rest
        converged = self._follower().at_rest(rest)
        return Fitted(self.natural(rest.theta), rest.theta, rest.objective, converged, made.fraction, made.exact)

    def natural(self, theta: Array) -> float:
        """The constant's value."""
        u = torch.from_numpy(theta[self.parameters.places])
        return float(self.parameters.bijections(self.parameters.shared).to_natural(u)[self.place])

    def said_of_estimate(self, estimate: float) -> list[str]:
        """A note where the estimate is not the value of the run's member; not at a bound, where no deviation holds."""
        if self.name in self.ended:
            return []
        fitted, learnable = self._known()[self.name], self.model.learnables[self.parameters.shared[self.place]]
        u = Bijections.of((learnable,)).from_natural(np.array([[fitted], [estimate]]))
        apart = abs(float(u[1, 0] - u[0, 0])) / max(self.deviation * self.widening, 1e-300)
        return said_of_estimate(self.name, fitted, estimate, apart, bool(self.parameters.n_weights))

    def others(self, one: Fitted) -> dict[str, float]:
        """The other learned constants of a fit (for a constant per trajectory the mean)."""
        known = len(self.model.constants)
        values = self.parameters.constants(torch.from_numpy(one.theta)).numpy().mean(axis=0)[known:]
        named = zip(self.model.learnables, values, strict=True)
        return {k.name: float(v) for k, v in named if k.name != self.name}

    # ---------------------------------------------------------------- vectors
    def _moved_measured_starts(self) -> bool:
        """Whether the run's fit treated measured initial values as measurements, as fits of whole solutions to noisy
        data do."""
        starts = np.asarray(self.weights.get("initial", np.zeros((0, 0))))
        kept = (self.free.start_free == 0) & [not state.initial.known for state in self.model.states]
        return starts.shape == kept.shape and not np.allclose(starts[kept], self.free.start_value[kept], rtol=1e-9)

    @property
    def holds_measured_starts(self) -> bool:
        """Whether measured initial states keep their values in the refits."""
        measured = [state.initial.kind == "measured" for state in self.model.states]
        return bool(np.any((self.parameters.start_free == 0) & ~self.free.absent & measured))

    def _fixed(self) -> dict[str, Array]:
        """The arrays of the networks in the weights file that are not trained."""
        trained = self.free.parameters({}).weight_shapes
        return {k: v for k, v in self.weights.items() if k.startswith("network.") and k not in trained}

    def _known(self) -> dict[str, float]:
        """The run's constants by their names."""
        values = self.weights["constants"][len(self.model.constants) :]
        return {k.name: float(value) for k, value in zip(self.model.learnables, values, strict=True)}

    def _vector(self, parameters: Parameters, context: Context) -> Array:
        """The vector of the run's weights file; constants at bounds, from which no fit moves, are a little off them."""
        learnables, known = context.model.learnables, self._known()
        moved = [Bijection.of(k).inside(known[k.name], INSIDE if k.name in self.ended else 0.0) for k in learnables]
        table = np.tile(np.array(moved), (parameters.trajectories, 1))
        for i, learnable in enumerate(context.model.learnables):
            own = self.weights.get(f"per_trajectory.{learnable.name}")
            if own is not None and len(own) == len(table):
                table[:, i] = own
        theta = parameters.vector(self.weights, table)
        starts = np.asarray(self.weights.get("initial", np.zeros((0, 0))))
        return parameters.with_starts(theta, starts) if starts.shape == parameters.start_value.shape else theta

    def remarks(self, fits: Sequence[Fitted]) -> list[str]:
        """Sentences on the prior, the steps of fits, measured starts and the noise."""
        notes = [*self.notes, *self._said_of_steps(fits)]
        if self.holds_measured_starts:
            notes.append("measured initial states stay as measured, so their noise is not in the interval")
        if self.variance <= CLEAN**2:
            notes.append("the data are fitted to rounding error, so the deviance refers to the smallest noise allowed")
        if self.widening > 1:
            notes.append(f"residuals are autocorrelated: the interval is {self.widening:.2g} times as wide for it")
        return notes

    def _said_of_steps(self, fits: Sequence[Fitted]) -> list[str]:
        name, notes = self.name, []
        finer = [one for one in fits if one.fraction < 1.0]
        if finer:
            values = ", ".join(f"{one.value:.4g}" for one in finer)
            least = min(one.fraction for one in finer)
            what, size = ("largest step", "max_step") if self.free.tolerance() is None else ("tolerance", "tolerance")
            was, now = self.free.steps(1.0)[size], self.free.steps(least)[size]
            notes.append(
                f"the {what} of {was:.3g} of the fit is too large for {name} = {values}: there it is down to {now:.3g}"
            )
        unsure = ", ".join(f"{one.value:.4g}" for one in fits if not one.exact)
        if unsure:
            notes.append(f"with {name} = {unsure} the deviance depends on the solver's step: do not rely on it")
        return notes
