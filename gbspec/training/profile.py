"""The profile likelihood of a learned constant: how well everything else can make up for another value of it.

The constant is held at one value after the other, outwards from its estimate, and the weights, the other constants and
the initial states are fitted anew each time, from the neighbour's (Raue et al. 2009, Bioinformatics 25, 1923). What is
fitted are whole solutions from the initial states, with the weights' prior as it was found at the estimate. With
Phi the penalised half sum of squares, D = 2 (Phi - min Phi) / sigma^2 is the deviance; below 2.706, the 90 % point of
chi-squared with one degree of freedom, a value is within the interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Array, Trajectories
from gbspec.diagnostics import ComputationError, Diagnostic, UserError
from gbspec.ir.model import Constant, Model
from gbspec.runs.store import Run
from gbspec.training.context import Context, build_context
from gbspec.training.jacobian import linearise
from gbspec.training.levenberg import NormalEquations
from gbspec.training.newton import LevenbergMarquardt, LevenbergOptions, noise_variance
from gbspec.training.options import TrainOptions
from gbspec.training.parameters import Parameters
from gbspec.training.plan import FIRST_RIDGE
from gbspec.training.priors import Priors, standardised
from gbspec.training.problem import typical
from gbspec.training.unroll import solve

THRESHOLD = 2.705543454095404
"""The 90 % point of chi-squared with one degree of freedom, for intervals as wide as those of `fit.json`."""
STRIDE = 0.7
"""The first step from the estimate, in standard deviations of the linearised fit."""
GROWTH, SLOW = 1.6, 0.4
"""A step grows by this factor where the deviance's root rose by less than this."""
FAR = 2.0
"""A side is done when the deviance is this multiple of the threshold."""
ACCURACY = 0.02
"""By how much an iteration must change the deviance to be worth another one."""
CLEAN = 1e-6
"""The least standard deviation of noise, in deviations of the data, that a deviance is measured by."""

Report = Callable[[float, float], None]


@dataclass(frozen=True)
class ProfilePoint:
    """The constant held at `value`; `deviance` above the best point; `others`: the other constants there.

    `converged` is False where the fit had not come to rest after the iterations allowed: the deviance is too large.
    """

    value: float
    deviance: float
    others: dict[str, float]
    converged: bool


@dataclass(frozen=True)
class Profile:
    """A profile, by value. `low` and `high` end the 90 % interval; None where it was not left on that side, or
    where some fit had not come to rest."""

    name: str
    member: int
    estimate: float
    points: tuple[ProfilePoint, ...]
    low: float | None
    high: float | None
    noise: float
    notes: tuple[str, ...] = ()
    threshold: float = THRESHOLD

    @property
    def settled(self) -> bool:
        """Whether every fit came to rest, so that the deviances mean something."""
        return all(point.converged for point in self.points)

    def to_json(self) -> dict[str, object]:
        """The document of `profile --json`."""
        return {
            "constant": self.name,
            "member": self.member,
            "estimate": self.estimate,
            "interval": [self.low, self.high],
            "threshold": self.threshold,
            "noise": self.noise,
            "points": [
                {"value": p.value, "deviance": p.deviance, "converged": p.converged, "constants": p.others}
                for p in self.points
            ],
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        ends = [f"{end:.6g}" if end is not None else "open" for end in (self.low, self.high)]
        interval = f"90 % interval {ends[0]} to {ends[1]}" if self.settled else "no interval, see the note"
        lines = [f"{self.name} = {self.estimate:.6g}, {interval}"]
        for point in self.points:
            inside = "inside" if point.deviance <= self.threshold else ""
            rest = "" if point.converged else "  not converged"
            lines.append(
                f"  {self.name} = {point.value:<12.6g} deviance {point.deviance:<10.4g} {inside}{rest}".rstrip()
            )
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def profile(
    run: Run,
    name: str,
    trajectories: Trajectories,
    *,
    member: int | None = None,
    points: int = 8,
    iterations: int = 8,
    progress: Report | None = None,
) -> Profile:
    """The profile of a constant that all trajectories share, at most `points` values to either side.

    Raises UserError (GB858) where there is no such constant, ComputationError where the fit cannot be started.
    """
    _check(run.model, name)
    number = run.best if member is None else member
    profiler = _Profiler(run, name, trajectories, number, iterations)
    best, step = profiler.estimate()
    found = [best]
    notes: list[str] = []
    bounds = next(k.range for k in run.model.learnables if k.name == name)
    for direction in (-1.0, 1.0):
        end = bounds.low if direction < 0 else bounds.high
        found += _side(profiler, best, direction * step, end, points, notes, progress)
    return _assembled(name, number, sorted(found, key=lambda one: one.value), profiler, notes)


def _check(model: Model, name: str) -> None:
    known = [k.name for k in model.learnables if not k.per_trajectory]
    if name not in known:
        listed = ", ".join(f"`{one}`" for one in known)
        help = f"the shared learned constants are {listed}" if known else "the model has no shared learned constant"
        message = f"`{name}` is not a learned constant that all trajectories share"
        raise UserError([Diagnostic("GB858", message, None, help=help, subject=name)])


@dataclass(frozen=True)
class _Fitted:
    """A fit with the constant at `value`: its vector and its penalised half sum of squares."""

    value: float
    theta: Array
    objective: float
    converged: bool


class _Profiler:
    """Fits with the constant free, then held."""

    def __init__(self, run: Run, name: str, trajectories: Trajectories, member: int, iterations: int) -> None:
        fields = {k: v for k, v in run.fit.get("options", {}).items() if k in TrainOptions().to_json()}
        self.options = replace(TrainOptions(**fields), random_substeps=False)
        self.model, self.name, self.iterations = run.model, name, iterations
        self.weights: dict[str, Array] = run.member(member).weights
        seed = self.options.seed + member
        self.free = build_context(run.model, run.module, trajectories, self.options, seed)
        pinned = held(run.model, name, 0.0)
        self.pinned = build_context(pinned, load_module(pinned), trajectories, self.options, seed)
        self.released = self._moved_measured_starts()
        self.ridge, self.variance, self.values = 0.0, 1.0, int((self.free.packed().weights > 0).sum())

    def estimate(self) -> tuple[_Fitted, float]:
        """The fit with everything free, and the first step to take from it."""
        context = self.free
        parameters = context.parameters(self._fixed(), released=self.released)
        theta = self._vector(parameters, context)
        noise = max(typical(solve(context.problem(0.0), parameters, theta)), 1e-2)
        noise = noise if math.isfinite(noise) else 1.0
        ridge = FIRST_RIDGE * noise**2 if parameters.n_weights else 0.0
        found, self.ridge = self._fit(context, parameters, theta, ridge, evidence=parameters.n_weights > 0)
        system = linearise(context.problem(0.0), parameters, found)
        residuals = system.residuals.numpy()
        equations = NormalEquations(system, parameters, np.ones(len(residuals)), self.ridge, found)
        scale = max(float(np.mean(residuals**2)), CLEAN**2)
        freedom = len(parameters.shared) + float(parameters.free[parameters.n_shared :].sum())
        if parameters.n_weights:
            freedom = equations.degrees_of_freedom(max(1e-6 * scale, _rounding(equations)), context.seed)
        self.variance = max(noise_variance(equations, residuals, float("inf"), freedom), CLEAN**2)
        value, deviation = self._spread(parameters, equations, found)
        best = self.held(value, self._carried(parameters, found))
        return best, STRIDE * deviation

    def _spread(self, parameters: Parameters, equations: NormalEquations, theta: Array) -> tuple[float, float]:
        """The constant's value and its linearised standard deviation."""
        index = [k.name for k in self.model.learnables].index(self.name)
        column = parameters.n_weights + parameters.shared.index(index)
        unit = np.zeros(parameters.size)
        unit[column] = 1.0
        inverse = float(equations.invert(unit, _rounding(equations))[column])
        at = torch.from_numpy(theta)
        value = float(parameters.constants(at)[0, len(self.model.constants) + index])
        u = theta[parameters.n_weights : parameters.n_shared]
        slope = float(parameters.bijections(parameters.shared).derivative(u)[parameters.shared.index(index)])
        deviation = math.sqrt(max(inverse, 0.0) * self.variance) * abs(slope)
        if not 0 < deviation < max(abs(value), 1e-3):
            deviation = 0.1 * max(abs(value), 1e-3)
        return value, deviation

    def held(self, value: float, start: Array) -> _Fitted:
        """The fit with the constant at `value`, from the vector `start` of a neighbour."""
        context = replace(self.pinned, model=held(self.model, self.name, value))
        parameters = context.parameters(self._fixed(), released=self.released)
        theta, converged = start, True
        if parameters.n_shared or parameters.free[parameters.n_shared :].any():
            theta, converged = self._refit(context, parameters, start)
        residuals = solve(context.problem(0.0), parameters, theta)
        penalty = self.ridge * float(np.sum(theta[: parameters.n_weights] ** 2)) + self._priors(context, theta, value)
        return _Fitted(value, theta, 0.5 * (float(residuals @ residuals) + penalty), converged)

    def _priors(self, context: Context, theta: Array, value: float) -> float:
        """Twice the penalty of all priors, that of the constant itself among them, in units of squared residuals."""
        problem = context.problem(0.0)
        problem = replace(problem, scaling=replace(problem.scaling, noise=math.sqrt(self.variance)))
        others = 2 * Priors.of(problem, context.parameters(self._fixed(), released=self.released), np.zeros(0)).penalty(
            theta
        )
        own = next(k.prior for k in self.model.learnables if k.name == self.name)
        if own is None:
            return others
        return others + self.variance * float(standardised(own, torch.tensor(value, dtype=torch.float64))) ** 2

    def others(self, one: _Fitted) -> dict[str, float]:
        """The other learned constants of a fit (of those that each trajectory has, the mean)."""
        model = held(self.model, self.name, one.value)
        parameters = replace(self.pinned, model=model).parameters(self._fixed(), released=self.released)
        values = parameters.constants(torch.from_numpy(one.theta)).numpy().mean(axis=0)[len(model.constants) :]
        return {k.name: float(v) for k, v in zip(model.learnables, values, strict=True)}

    # ---------------------------------------------------------------- vectors
    def _moved_measured_starts(self) -> bool:
        """Whether the run's fit took measured starts for measurements, as whole solutions of noisy data do."""
        starts = np.asarray(self.weights.get("initial", np.zeros((0, 0))))
        kept = (self.free.start_free == 0) & [state.initial.kind != "expression" for state in self.model.states]
        return starts.shape == kept.shape and not np.allclose(starts[kept], self.free.start_value[kept], rtol=1e-9)

    def _fixed(self) -> dict[str, Array]:
        """What the weights file holds of the networks beside what is trained."""
        trained = self.free.parameters({}).weight_shapes
        return {k: v for k, v in self.weights.items() if k.startswith("network.") and k not in trained}

    def _vector(self, parameters: Parameters, context: Context) -> Array:
        """The run's own vector."""
        known = len(context.model.constants)
        table = np.tile(np.asarray(self.weights["constants"])[known:], (parameters.trajectories, 1))
        for i, learnable in enumerate(context.model.learnables):
            own = self.weights.get(f"per_trajectory.{learnable.name}")
            if own is not None and len(own) == len(table):
                table[:, i] = own
        theta = parameters.vector(self.weights, table)
        starts = np.asarray(self.weights.get("initial", np.zeros((0, 0))))
        return parameters.with_starts(theta, starts) if starts.shape == parameters.start_value.shape else theta

    def _carried(self, parameters: Parameters, theta: Array) -> Array:
        """The vector without the constant's entry."""
        index = [k.name for k in self.model.learnables].index(self.name)
        return np.delete(theta, parameters.n_weights + parameters.shared.index(index))

    # ---------------------------------------------------------------- fits
    def _refit(self, context: Context, parameters: Parameters, start: Array) -> tuple[Array, bool]:
        stage = self._stage(context, parameters, LevenbergOptions(False, self._tolerance, 0.1, self.ridge))
        return _run(stage, start)[:2]

    def _fit(
        self, context: Context, parameters: Parameters, theta: Array, ridge: float, *, evidence: bool
    ) -> tuple[Array, float]:
        stage = self._stage(context, parameters, LevenbergOptions(False, self._tolerance, 0.1, ridge, evidence))
        stage.total *= 2
        found, _, state = _run(stage, theta)
        return found, float(state["ridge"])

    def _stage(self, context: Context, parameters: Parameters, options: LevenbergOptions) -> LevenbergMarquardt:
        return LevenbergMarquardt("profile", self.iterations, lambda i: context.problem(0.0), parameters, options)

    @property
    def _tolerance(self) -> float:
        """The relative decrease of the objective that changes the deviance by `ACCURACY`."""
        return ACCURACY / max(self.values, 1)


def held(model: Model, name: str, value: float) -> Model:
    """The model with a learned constant known."""
    learnable = next(k for k in model.learnables if k.name == name)
    known = Constant(name, value, unit=learnable.unit, description=learnable.description)
    rest = tuple(k for k in model.learnables if k.name != name)
    return replace(model, constants=(*model.constants, known), learnables=rest)


def _rounding(equations: NormalEquations) -> float:
    """The least damping with which the normal equations can be solved in spite of rounding."""
    return 1e-11 * float(np.sum(equations.shared**2) + np.sum(equations.local**2))


def _run(stage: LevenbergMarquardt, theta: Array) -> tuple[Array, bool, dict[str, Any]]:
    """A stage to its end: the vector, whether it came to rest, its last state."""
    state = stage.begin(theta)
    for iteration in range(stage.total):
        outcome = stage.step(state, iteration)
        state = outcome.state
        if outcome.done:
            return state["theta"], True, state
    return state["theta"], False, state


def _side(
    profiler: _Profiler,
    best: _Fitted,
    step: float,
    end: float,
    most: int,
    notes: list[str],
    progress: Report | None,
) -> list[_Fitted]:
    """The fits to one side of the estimate, until the deviance is large, the bound is near or `most` are made."""
    found: list[_Fitted] = []
    here, root = best, 0.0
    for _ in range(most):
        value = here.value + step
        if (end - value) * step <= 0:
            value = here.value + 0.5 * (end - here.value)
            if abs(end - here.value) < 1e-3 * abs(step) or not math.isfinite(value):
                break
        try:
            here = profiler.held(value, here.theta)
        except ComputationError as error:
            notes.append(f"at {profiler.name} = {value:.6g} the fit failed: {error.what}")
            break
        found.append(here)
        deviance = 2.0 * (here.objective - best.objective) / profiler.variance
        if progress is not None:
            progress(value, deviance)
        if deviance > FAR * THRESHOLD:
            break
        risen, root = math.sqrt(max(deviance, 0.0)) - root, math.sqrt(max(deviance, 0.0))
        step *= GROWTH if risen < SLOW else 1.0
    return found


def _assembled(name: str, member: int, fits: list[_Fitted], profiler: _Profiler, notes: list[str]) -> Profile:
    """Deviances above the best of all fits, and where they cross the threshold."""
    least = min(fits, key=lambda one: one.objective)
    points = tuple(
        ProfilePoint(one.value, 2.0 * (one.objective - least.objective) / profiler.variance, profiler.others(one),
                     one.converged)
        for one in fits
    )  # fmt: skip
    at = fits.index(least)
    low, high = _crossing(points[at::-1]), _crossing(points[at:])
    slow = sum(not point.converged for point in points)
    if slow:
        low = high = None
        notes.append(f"{slow} of {len(points)} fits had not come to rest, so their deviances are too large and no "
                     "interval can be given: allow more `--iterations`")  # fmt: skip
    else:
        open_sides = [side for side, end in (("below", low), ("above", high)) if end is None]
        notes += [f"the data do not bound {name} {side}, as far as it was followed" for side in open_sides]
    if np.any(profiler.free.start_free == 0) and any(s.initial.kind == "measured" for s in profiler.model.states):
        notes.append("measured initial states stay as measured, so their noise is not in the interval")
    if profiler.variance <= CLEAN**2:
        notes.append("the data are followed to rounding, so the deviance is measured by the least noise allowed")
    return Profile(name, member, least.value, points, low, high, math.sqrt(profiler.variance), tuple(notes))


def _crossing(points: tuple[ProfilePoint, ...]) -> float | None:
    """Where the deviance first crosses the threshold outwards; its root, straight for a parabola, is interpolated."""
    level = math.sqrt(THRESHOLD)
    for a, b in pairwise(points):
        first, second = (math.sqrt(max(p.deviance, 0.0)) for p in (a, b))
        if first <= level < second:
            return a.value + (level - first) / (second - first) * (b.value - a.value)
    return None
