"""The stages of models with populations or learned noises: a pooled fit, then the marginal likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.training.engines import explain_failure
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Stage
from gbspec.training.population import (
    Groups,
    Layout,
    Marginal,
    MarginalLikelihood,
    Objective,
    Pooled,
    Predictions,
    modes_of,
    pooled_parameters,
)
from gbspec.training.problem import Parameters
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.finer import HALVINGS
from gbspec.training.recipe.planned import Planned, Reached, step_fraction
from gbspec.training.stages import Effort, StageName, most_iterations
from gbspec.training.starts import PATIENCE, Search

MOST_NODES = 50_000
"""The most nodes of a quadrature over all deviations of a unit."""
SHOWS, SHOWS_WITH_NETWORKS = 0.02, 0.5
"""The step is halved where that changes -2 log likelihood by more than this."""


def marginal_objective(context: Context, parameters: Parameters, fraction: float) -> Objective:
    """The objective of a population at a fraction of the largest step."""
    layout = Layout(parameters)
    names = tuple(k.name for k in layout.distributed)
    predictions = Predictions(context.problem(0.0, fraction), parameters, context.choice, names)
    size, nodes = Groups.of(layout, predictions.problem.packed.condition).size, context.options.quadrature
    if nodes > 1 and nodes**size > MOST_NODES:
        solutions = f"{float(nodes) ** size:.1g}"
        message = f"quadrature with {nodes} nodes in each of {size} dimensions takes {solutions} solutions"
        help = "leave `--quadrature` out: Laplace's method takes one; groups of trajectories count together"
        raise UserError([Diagnostic("GB787", message, None, help=help)])
    return Objective(Marginal(layout, predictions, nodes))


def check_starts(context: Context) -> None:
    """Raises UserError (GB776) where the start of a state is not known: nothing in the likelihood can learn it."""
    free = np.argwhere(context.start_free > 0)
    if not len(free):
        return
    trajectory, state = (int(i) for i in free[0])
    name, label = context.model.states[state].name, context.trajectories.items[trajectory].label
    message = f"the start of `{name}` in trajectory `{label}` is neither given by the model nor measured"
    help_text = (
        f"write `initial {name} = …`, with a constant `learn {name}_0 = … per trajectory ~ lognormal` where it differs"
    )
    raise UserError([Diagnostic("GB776", message, None, help=help_text)])


def stages(context: Context, parameters: Parameters, regular: Callable[[Array], LevenbergOptions]) -> list[Planned]:
    """The stages of a population, in order."""
    check_starts(context)
    effort = context.options.effort
    pooled = pooled_parameters(parameters)
    most = most_iterations(StageName.MARGINAL, effort)
    objectives: dict[float, Objective] = {}

    def objective(fraction: float) -> Objective:
        if fraction not in objectives:
            objectives[fraction] = marginal_objective(context, parameters, fraction)
        return objectives[fraction]

    def search(reached: Reached) -> Stage:
        engine, forced = (context.engine(pooled, blend) for blend in (0.0, 1.0))
        # Its minimum is only a start: few draws are enough where the effort is not high.
        patience: Effort = "high" if effort == "high" else "low"
        return Pooled(Search(engine, forced, context.seed, patience), engine, parameters)

    def least_squares(reached: Reached) -> Stage:
        engine = context.engine(pooled, 0.0)
        options = replace(regular(reached.theta), tolerance=1e-3, evidence=False)
        total = most_iterations(StageName.POOLED, effort)
        inner = LevenbergMarquardt(StageName.POOLED.value, total, lambda iteration: engine, options)
        return Pooled(inner, engine, parameters)

    def maximised(name: StageName, fraction: float) -> Stage:
        def failure(theta: Array) -> Exception:
            return explain_failure(context.problem(0.0, fraction), parameters, theta, name.value)

        return MarginalLikelihood(name.value, most, parameters, objective(fraction), _ridge(context), failure)

    def finer(number: int) -> Planned:
        def shows(reached: Reached) -> bool:
            if context.options.max_step is not None or list(reached.begun).count(StageName.FINER) != number - 1:
                return False
            fraction, limit = step_fraction(reached.begun), SHOWS_WITH_NETWORKS if parameters.n_weights else SHOWS
            return (
                abs(_at(objective(fraction / 2), parameters, reached) - _at(objective(fraction), parameters, reached))
                > limit
            )

        def make(reached: Reached) -> Stage:
            return maximised(StageName.FINER, step_fraction(reached.begun) / 2)

        return Planned(StageName.FINER, most, make, possible=shows)

    first = (
        Planned(StageName.POOLED, most_iterations(StageName.POOLED, effort), least_squares)
        if parameters.n_weights
        else Planned(StageName.SEARCH, PATIENCE[effort].improved, search)
    )
    last = Planned(
        StageName.MARGINAL, most, lambda reached: maximised(StageName.MARGINAL, step_fraction(reached.begun))
    )
    return [first, last, *(finer(number) for number in range(1, HALVINGS[effort] + 1))]


def _ridge(context: Context) -> float | None:
    """The inverse variance of the weights' prior, if it was requested; None: the one of greatest evidence."""
    if not context.options.ridge:
        return context.options.ridge
    initial = np.concatenate([v.ravel() for k, v in context.module.weights.items() if k.endswith("weight")])
    return float(1 / (context.options.ridge**2 * np.mean(initial**2)))


def _at(objective: Objective, parameters: Parameters, reached: Reached) -> float:
    """Minus twice the log likelihood at what has been reached."""
    theta, layout = reached.theta, objective.layout
    z = modes_of(parameters, objective.marginal.likelihood, theta)
    return objective.at(theta[: parameters.n_weights], theta[layout.slice()], z, 0.0, afresh=True).minus2ll
