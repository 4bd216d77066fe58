"""The stages of models with populations or learned noises: a pooled fit, then the marginal likelihood."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Trajectories, absent_states
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model
from gbspec.training.engines import Engine, explain_failure
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, OtherMaxima, Stage
from gbspec.training.options import TrainOptions
from gbspec.training.population import (
    Exchanged,
    Groups,
    Layout,
    Marginal,
    MarginalLikelihood,
    Objective,
    Point,
    Pooled,
    Starts,
    TimesOfJumps,
    modes_of,
    pooled_parameters,
    pooled_vector,
    values_of,
)
from gbspec.training.problem import Parameters, pack
from gbspec.training.recipe.context import Context, learned_starts, split
from gbspec.training.recipe.cutting import only_in_jumps
from gbspec.training.recipe.finer import HALVINGS
from gbspec.training.recipe.growing import ATTEMPTS, GrowingHorizons, other_weights
from gbspec.training.recipe.judging import ASTRAY, FEW, LOST, channel_errors
from gbspec.training.recipe.planned import Planned, Reached, step_fraction
from gbspec.training.recipe.rivals import JudgedSearch
from gbspec.training.recipe.segments import horizons
from gbspec.training.stages import Effort, StageName, most_iterations
from gbspec.training.starts import PATIENCE, Search

MOST_NODES = 50_000
"""The most nodes of a quadrature over all deviations of a unit."""
AUTOMATIC: Mapping[int, int] = {1: 9, 2: 7}
"""Nodes in each dimension of a quadrature that the fit itself asks for, by the number of dimensions of a unit."""
MOVES = 0.2
"""It asks for one that would move a parameter by more than this many of its standard deviations."""
SHOWS, SHOWS_WITH_NETWORKS = 0.02, 0.5
"""The step is halved where that changes -2 log likelihood by more than this."""
TWICE = 2.0
"""Whole solutions follow counts with residuals of at most so many standard deviations of their noise, as the declared
size has it."""
_POOLED_FITS = StageName.POOLED, StageName.POOLED_AGAIN


def marginal_objective(context: Context, parameters: Parameters, begun: Sequence[str]) -> Objective:
    """The objective of a population after the stages that have begun, which tell the step and the quadrature.

    Raises UserError (GB787) if a quadrature was requested that takes too many solutions.
    """
    problem = context.problem(0.0, step_fraction(begun))
    size, nodes = Groups.of(Layout(parameters), problem.packed.condition).size, context.options.quadrature
    if nodes is None:
        nodes = AUTOMATIC.get(size, 1) if StageName.QUADRATURE in begun else 1
    if nodes > 1 and nodes**size > MOST_NODES:
        solutions = f"{float(nodes) ** size:.1g}"
        message = f"quadrature with {nodes} nodes in each of {size} dimensions takes {solutions} solutions"
        help = "leave `--quadrature` out: Laplace's method takes one; groups of trajectories count together"
        raise UserError([Diagnostic("GB787", message, None, help=help)])
    return Objective(Marginal.of(problem, parameters, context.choice, nodes))


def check_starts(model: Model, trajectories: Trajectories, options: TrainOptions) -> None:
    """Raises UserError (GB776) where the start of a state is not known in data of a model with a marginal likelihood:
    nothing in that can learn it."""
    if not model.marginal:
        return
    kept, _ = split(trajectories, options.holdout, options.seed)
    learned = learned_starts(model, pack(kept, model, np.inf)) > 0
    free = np.argwhere(learned & ~absent_states(model, kept.items))
    if not len(free):
        return
    trajectory, state = (int(i) for i in free[0])
    name, label = model.states[state].name, kept.items[trajectory].label
    message = f"the start of `{name}` in trajectory `{label}` is neither given by the model nor measured"
    help_text = (
        f"write `initial {name} = …`, with a constant `learn {name}_0 = … per trajectory ~ lognormal` where it differs"
    )
    raise UserError([Diagnostic("GB776", message, None, help=help_text)])


def stages(context: Context, parameters: Parameters, regular: Callable[[Reached], LevenbergOptions]) -> list[Planned]:
    """The stages of a population, in order."""
    effort = context.options.effort
    pooled = pooled_parameters(parameters)
    likelihoods = _Likelihoods(context, parameters)
    # With distributed constants its minimum is only a start: few draws are enough where the effort is not high. With a
    # learned noise alone it is the minimum, but for the noise.
    patience: Effort = "low" if context.model.distributed and effort != "high" else effort

    def search(reached: Reached) -> Stage:
        engine, forced = (context.engine(pooled, blend) for blend in (0.0, 1.0))
        found = Search(engine, forced, context.seed, patience, finer=lambda: context.engine(pooled, 0.0, 0.5))
        if context.model.distributed:
            return Pooled(found, engine, parameters)
        return JudgedSearch(found, engine, parameters, likelihoods.compared(reached))

    def fitted(name: StageName) -> Planned:
        total = most_iterations(name, effort)

        def least_squares(reached: Reached) -> Stage:
            options = replace(regular(reached), tolerance=1e-3, evidence=False)
            layout = pooled_parameters(parameters, reached.theta) if name is StageName.FUNCTIONS else pooled
            engine = context.engine(layout, 0.0)
            start = reached.marks[StageName.WARM_START] if name is StageName.POOLED_AGAIN else None
            return Pooled(LevenbergMarquardt(name.value, total, lambda i: engine, options), engine, parameters, start)

        return Planned(name, total, least_squares)

    first = (
        [
            *(fitted(name) for name in (StageName.FUNCTIONS, StageName.POOLED, StageName.POOLED_AGAIN)),
            *([] if context.model.distributed else [_segments(context, parameters)]),
        ]
        if parameters.n_weights
        else [Planned(StageName.SEARCH, PATIENCE[patience].improved, search)]
    )
    finer = (likelihoods.finer(number) for number in range(1, HALVINGS[effort] + 1))
    around, near = likelihoods.jumps(near=False), likelihoods.jumps(near=True)
    return [*first, likelihoods.marginal(), around, likelihoods.other_maxima(), *finer, near, likelihoods.quadrature()]


def _segments(context: Context, parameters: Parameters) -> Planned:
    """Segments of growing length, where both pooled fits of a model without distributions leave whole solutions far
    from the data: from the vectors of these, and from other random weights."""
    pooled = pooled_parameters(parameters)
    engine, parts = context.engine(pooled, 0.0), len(horizons(context))
    effort = context.options.effort
    most = len(_POOLED_FITS) + ATTEMPTS[effort]

    def reached_by(reached: Reached) -> list[Array]:
        marks = [reached.marks[name] for name in _POOLED_FITS if name in reached.marks] or [reached.theta]
        return [pooled_vector(parameters, pooled, mark) for mark in marks]

    def astray(reached: Reached) -> bool:
        return all(_far(engine, vector) for vector in reached_by(reached))

    def make(reached: Reached) -> Stage:
        declared = pooled.vector(context.module.weights)
        others = [other_weights(context, pooled, declared, number + 1) for number in range(ATTEMPTS[effort])]
        starts = [*reached_by(reached), *others]
        growing = GrowingHorizons(context, pooled, starts, effort, followed=_noise_of_counts(engine))
        return Pooled(growing, engine, parameters)

    return Planned(StageName.HORIZONS, parts * most, make, astray, lambda reached: parts > 0)


def _far(engine: Engine, vector: Array) -> bool:
    """Whether whole solutions are far from the data in a channel: of counts by `TWICE` their noise, of others by a part
    of their deviation, which with few values only errors larger than all of it are, since segments follow noise."""
    problem, errors = engine.problem, channel_errors(engine, vector)
    counts = np.zeros(len(errors), dtype=bool) if problem.scaling.sizes is None else problem.scaling.sizes > 0
    limit = ASTRAY if np.count_nonzero(problem.seen) >= FEW else LOST
    limits = np.where(counts, TWICE / problem.scaling.row_scale.max(axis=0, initial=0.0), limit)
    return bool((~(errors <= limits)).any())


def _noise_of_counts(engine: Engine) -> float | None:
    """The loss with `TWICE` the noise of counts, whose residuals know its size; None where other channels do not."""
    problem = engine.problem
    if problem.scaling.sizes is None or not (problem.scaling.sizes > 0).all():
        return None
    return 0.5 * TWICE**2 * float(np.mean(problem.scaling.row_scale[problem.seen] ** -2.0))


def jumping(parameters: Parameters) -> list[int]:
    """The places among the parameters u of the constants by which the likelihood has no derivative; of distributed ones
    those of their medians."""
    found = set(only_in_jumps(parameters.model))
    return [place for name, place in Layout(parameters).typical.items() if name in found]


class _Likelihoods:
    """The stages that maximise the marginal likelihood, whose objectives follow from the stages that have begun."""

    def __init__(self, context: Context, parameters: Parameters) -> None:
        self._context, self._parameters = context, parameters
        self._most = most_iterations(StageName.MARGINAL, context.options.effort)
        self._objectives: dict[tuple[float, bool], Objective] = {}

    def marginal(self) -> Planned:
        """Laplace's method, or the quadrature that was requested."""

        def make(reached: Reached) -> Stage:
            marks = reached.marks
            elsewhere = tuple(marks[name] for name in _POOLED_FITS if name in marks)
            others = Starts(elsewhere, marks.get(StageName.FUNCTIONS))
            return self._maximised(StageName.MARGINAL, *reached.begun, others=others)

        return Planned(StageName.MARGINAL, self._most, make)

    def jumps(self, *, near: bool) -> Planned:
        """The search for constants that occur only where values jump; `near`, after finer steps, of those found,
        unless steps end at the jumps: then derivatives have led to the place already."""
        places = [] if self._parameters.n_weights else jumping(self._parameters)
        known = self._context.cutting and not only_in_jumps(self._context.solved)

        def sought(reached: Reached) -> bool:
            return bool(places) and (not near or (StageName.FINER in reached.begun and not known))

        def make(reached: Reached) -> Stage:
            inner = self._maximised(StageName.JUMPS, *reached.begun)
            return TimesOfJumps(StageName.JUMPS.value, inner, places, near)

        return Planned(StageName.JUMPS, values_of(near) * max(len(places), 1), make, possible=sought)

    def other_maxima(self) -> Planned:
        """The search for other maxima where constants exchange their roles. With learned noises alone the search of
        least squares has looked over the whole ranges."""

        def made(reached: Reached) -> OtherMaxima:
            taken = reached.iterations.get(StageName.MARGINAL, 0)
            return OtherMaxima(StageName.OTHER_MAXIMA, self._most, self.compared(reached), taken)

        def possible(reached: Reached) -> bool:
            known = self._context.model.distributed and not self._parameters.n_weights
            return bool(known) and reached.maximum and made(reached).possible(reached.theta)

        return Planned(StageName.OTHER_MAXIMA, self._most, made, possible=possible)

    def compared(self, reached: Reached) -> Exchanged:
        """The likelihood, as one whose maxima are compared."""
        fit = self._maximised(StageName.MARGINAL, *reached.begun)
        return Exchanged(fit, lambda: self._objective(*reached.begun, StageName.FINER))

    def finer(self, number: int) -> Planned:
        """The same at half the step (adaptive: a tenth of the tolerance), where that changes the likelihood."""
        options, weights = self._context.options, self._parameters.n_weights

        def shows(reached: Reached) -> bool:
            given = options.tolerance if self._context.adaptive else options.max_step
            if given is not None or list(reached.begun).count(StageName.FINER) != number - 1:
                return False
            now, half = self._objective(*reached.begun), self._objective(*reached.begun, StageName.FINER)
            change = self._at(half, reached).minus2ll - self._at(now, reached).minus2ll
            return abs(change) > (SHOWS_WITH_NETWORKS if weights else SHOWS)

        def make(reached: Reached) -> Stage:
            return self._maximised(StageName.FINER, *reached.begun, StageName.FINER)

        return Planned(StageName.FINER, self._most, make, possible=shows)

    def quadrature(self) -> Planned:
        """Quadrature, where it was not fixed and moves a parameter."""
        options, weights = self._context.options, self._parameters.n_weights

        def moves(reached: Reached) -> bool:
            if options.quadrature is not None or weights or options.effort == "low":
                return False
            whole = self._objective(*reached.begun, StageName.QUADRATURE)
            return whole.marginal.nodes > 1 and _moves(whole, self._at(whole, reached))

        def make(reached: Reached) -> Stage:
            return self._maximised(StageName.QUADRATURE, *reached.begun, StageName.QUADRATURE)

        return Planned(StageName.QUADRATURE, self._most, make, possible=moves)

    def _objective(self, *begun: str) -> Objective:
        key = step_fraction(begun), StageName.QUADRATURE in begun
        if key not in self._objectives:
            self._objectives[key] = marginal_objective(self._context, self._parameters, begun)
        return self._objectives[key]

    def _maximised(self, name: StageName, *begun: str, others: Starts | None = None) -> MarginalLikelihood:
        context, parameters = self._context, self._parameters

        def failure(theta: Array) -> Exception:
            return explain_failure(context.problem(0.0, step_fraction(begun)), parameters, theta, name.value)

        objective = self._objective(*begun)
        said = self._finer(step_fraction(begun)) if name is StageName.FINER else ""
        return MarginalLikelihood(name.value, self._most, parameters, objective, _ridge(context), failure, others, said)

    def _finer(self, fraction: float) -> str:
        """What a finer step is: likelihoods at different steps differ by the error of the step, also without a fit."""
        rtol = self._context.tolerance(fraction)
        if rtol is None:
            size = f"largest step {fraction * self._context.max_step:.3g}, half of that before"
        else:
            size = f"tolerance {rtol:.3g}, a tenth of that before"
        return f" ({size}; likelihoods at different steps also differ by the error of the step)"

    def _at(self, objective: Objective, reached: Reached) -> Point:
        """The point that has been reached."""
        theta, parameters, layout = reached.theta, self._parameters, objective.layout
        z = modes_of(parameters, objective.marginal.likelihood, theta)
        return objective.at(theta[: parameters.n_weights], theta[layout.slice()], z, 0.0, afresh=True)


def _ridge(context: Context) -> float | None:
    """The inverse variance of the weights' prior, if it was requested; None: the one of greatest evidence. Without
    networks there are no weights, and none is needed."""
    if not context.options.ridge or not context.model.networks:
        return context.options.ridge
    initial = np.concatenate([v.ravel() for k, v in context.module.weights.items() if k.endswith("weight")])
    return float(1 / (context.options.ridge**2 * np.mean(initial**2)))


def _moves(objective: Objective, point: Point) -> bool:
    """Whether a scoring step moves a parameter by more than MOVES of its standard deviations."""
    if not np.isfinite(point.minus2ll):
        return False
    # The expected Hessian is that of -2 log L: twice its inverse is the covariance.
    inverse = np.linalg.pinv(objective.curvature(point, 0.0), hermitian=True)
    step, sd = inverse @ objective.gradient(point, 0.0), np.sqrt(2 * np.maximum(np.diag(inverse), 0.0))
    return bool(np.isfinite(step).all() and (np.abs(step) > MOVES * sd).any())
