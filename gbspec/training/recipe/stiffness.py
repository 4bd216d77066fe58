"""The choice of the solver where it is left to the training: explicit unless the equations are stiff.

Equations are stiff for a step where their fastest decay is beyond the step's limit of stability. This is looked at
before the first fit, at the measured states (curves through the data) with the constants of gradient matching: known
parts of the equations show it, the slope of an unknown function does not. Where all forms are known, and the explicit
solver fails at many constants within their ranges, the draws of the search are compared by both solvers. Populations
take smaller explicit steps where these are stable and not too many.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, load_module
from gbspec.data import Trajectories, evenly_spaced
from gbspec.ir import AUTO, DOPRI5, RK4, STIFF, Model, linear_in_states
from gbspec.training.engines import rate_slopes, torch_arithmetic
from gbspec.training.options import TrainOptions
from gbspec.training.population import Pooled, pooled_parameters
from gbspec.training.problem import Integers, Parameters, Problem, default_max_step
from gbspec.training.recipe.context import Context, build_context
from gbspec.training.recipe.preparation import Prepared, at_step, initial, prepare
from gbspec.training.recipe.stages import imputed_forcing
from gbspec.training.starts import Search

LIMIT = 2.8
"""The limit of stability of `rk4`: step times rate of a decay."""
NEAR = 0.5
"""Solutions beyond this share of the limit are near it: a fit cannot cross it, and may have come to rest there."""
SHARE = 0.1
"""Equations count as stiff where at least this share of the points is beyond the limit."""
HOPELESS = 30.0
"""Errors that grow by more than e to this within a trajectory exceed it from rounding alone."""
SHORT = 5.0
"""In pieces of so many times of growth errors grow by e to this: a start shows, and its error does not take over."""
MANY = 1000
"""With more fixed steps than this between two rows on average, times spread over so many scales that steps have to."""
UNSOLVED, BETTER, MOST = 0.2, 0.9, 0.5
"""Draws of constants are looked at with the stiff solver too where at least the share `UNSOLVED` cannot be solved with
the explicit one; their best loss must be below `BETTER` times the best one there, or more than the share `MOST` of
all draws must be solved by the stiff one alone."""
REFINED = 16.0
"""Up to so many times the limit a population takes smaller explicit steps: a step that is merely long for a decay does
not make equations stiff, and the derivatives that its likelihood needs take far longer with the stiff solver."""
ACCURATE = 0.2
"""Step times rate up to which a step of `rk4` follows a decay to a few millionths."""
LOOKED_AT = 8
"""Most trajectories that are looked at."""
MOST_ROWS = 2000
"""About how many rows of a fit are looked at."""


def solver_of(options: TrainOptions) -> str:
    """The solver by the options alone: the one named, else the explicit one."""
    explicit = RK4 if options.tolerance is None else DOPRI5
    return explicit.name if options.solver == AUTO else options.solver


def chosen_solver(
    model: Model, module: type[GeneratedModule], trajectories: Trajectories, options: TrainOptions
) -> tuple[str, str | None]:
    """The solver for a model and its data, and the reason for it; `module` is the class with the explicit one.

    Models with delays are computed with the explicit one; disturbed models that are linear are solved exactly. Of
    models with algebraic variables the Jacobian is that of the reduced equations, and draws of constants, which are
    costly there, are not looked at.
    """
    if not _may_be_stiff(model):
        return solver_of(options), None
    step = options.max_step if options.max_step is not None else default_max_step(trajectories)
    steps, rows = _fixed_steps(trajectories, step)
    if options.max_step is None and steps > MANY * rows:
        return STIFF.name, (
            f"the times of the data spread over several decades: fixed steps would be {steps:.2g} between {rows} rows; "
            "dynamics on such different scales are usually stiff"
        )
    chosen = evenly_spaced(len(trajectories), LOOKED_AT)
    looking = replace(options, backend="torch", device="cpu", max_step=step, tolerance=None, holdout=0.0)
    some = trajectories if len(chosen) == len(trajectories) else trajectories.subset(chosen)
    context = build_context(model, module, some, looking, options.seed)
    parameters, theta = initial(context)
    rates = decays(context, parameters, theta)
    fast = _usual(rates)
    refined = _refined(model, options)
    if step * fast <= (REFINED if refined else 1.0) * LIMIT:
        # No solution from a start follows a disturbed one.
        drawn = model.complete and not (model.diffusions or model.algebraics)
        tried = replace(options, max_step=_stable(step * fast) * step) if refined else options
        reason = _by_draws(model, module, some, tried, theta) if drawn else None
        return (solver_of(options), None) if reason is None else (STIFF.name, reason)
    reason = (
        f"the equations are stiff: at the data they have rates of {fast:.3g}, which times the step of {step:.3g} is "
        f"{step * fast:.3g}, and an explicit method is stable up to {LIMIT}"
    )
    return STIFF.name, reason


def _refined(model: Model, options: TrainOptions) -> bool:
    """Whether the explicit step is adapted to the rates at the data: see `REFINED`."""
    chosen = options.max_step is None and options.tolerance is None
    return chosen and bool(model.distributed)


def prepared(
    model: Model, module: type[GeneratedModule], trajectories: Trajectories, options: TrainOptions, seed: int
) -> Prepared:
    """A member before its first stage, as from `prepare`; of a population at a step that is stable at the data."""
    found = prepare(model, module, trajectories, options, seed)
    fraction = _stable_fraction(found.context, found.parameters, found.theta)
    return found if fraction == 1.0 else at_step(found, fraction)


def at_stable_step(context: Context, parameters: Parameters, theta: Array) -> Context:
    """The context of a member that is resumed, with the step that `prepared` gave it; `theta`: its first vector."""
    fraction = _stable_fraction(context, parameters, theta)
    return context if fraction == 1.0 else context.finer(fraction)


def _stable_fraction(context: Context, parameters: Parameters, theta: Array) -> float:
    """The fraction of the default step that is stable at the data for a vector before the first stage; 1 where the step
    is not adapted."""
    if not _refined(context.model, context.options) or context.adaptive or not _may_be_stiff(context.model):
        return 1.0
    rates = decays(context, parameters, theta)
    return _stable(context.max_step * _usual(rates))


def _stable(product: float) -> float:
    """The fraction of a step that is stable where the step times the rate is `product`; 1 where it is stable itself, or
    where the fraction would be too small."""
    return 0.5 ** int(np.ceil(np.log2(product / (NEAR * LIMIT)))) if LIMIT < product <= REFINED * LIMIT else 1.0


def _usual(rates: Array) -> float:
    """The rate above which a `SHARE` of the points are; 0 without points."""
    return float(np.quantile(rates, 1 - SHARE)) if len(rates) else 0.0


def _by_draws(
    model: Model, module: type[GeneratedModule], trajectories: Trajectories, options: TrainOptions, theta: Array
) -> str | None:
    """The reason for the stiff solver where constants are drawn from their ranges, as the search does: that the best
    draws cannot be solved by the explicit one; else None."""

    def losses(of: type[GeneratedModule]) -> Array:
        context = build_context(model, of, trajectories, replace(options, holdout=0.0), options.seed)
        parameters = initial(context)[0]
        if not model.marginal:
            return Search(context.engine(parameters, 0.0), None, context.seed, "low").losses(theta)[1]
        search = Search(context.engine(pooled_parameters(parameters), 0.0), None, context.seed, "low")
        return search.losses(Pooled(search, search.engine, parameters).vector(theta))[1]

    explicit = losses(module)
    failed = ~np.isfinite(explicit)
    if failed.mean() < UNSOLVED:
        return None
    stiff = losses(load_module(model, STIFF))
    alone = failed & np.isfinite(stiff)
    if alone.mean() > MOST:
        return (
            f"of {len(explicit)} points drawn from the ranges of the constants, {int(alone.sum())} can be solved with "
            f"`{STIFF.name}` alone"
        )
    best = int(np.argmin(np.where(np.isfinite(stiff), stiff, np.inf)))
    if not (failed[best] and stiff[best] < BETTER * float(np.min(explicit, initial=np.inf, where=~failed))):
        return None
    return (
        f"of {len(explicit)} points drawn from the ranges of the constants, {int(failed.sum())} cannot be solved with "
        f"`{module.solver}`, among them the one that is nearest to the data"
    )


def _fixed_steps(trajectories: Trajectories, step: float) -> tuple[float, int]:
    """The number of fixed steps that the data need, and the number of rows."""
    gaps = [
        np.diff(np.concatenate([[item.start], item.times[item.times >= item.start]])) for item in trajectories.items
    ]
    return float(sum(np.ceil(each / step).sum() for each in gaps)), sum(len(each) for each in gaps)


def decays(context: Context, parameters: Parameters, theta: Array) -> Array:
    """The rates of the fastest modes at the measured states [P], 0 where such a mode grows; points where the equations
    have no finite derivatives are left out."""
    problem, states = _at_data(context, parameters, theta)
    return _fastest(problem, parameters, theta, states, np.arange(problem.packed.rows))


def step_of_drift(context: Context, parameters: Parameters, theta: Array) -> float:
    """A step by which the drift of a linear model with disturbances is solved well: its filter needs no such step, as
    its moments are exact from row to row."""
    usual = default_max_step(context.trajectories)
    product = usual * float(decays(context, parameters, theta).max(initial=0.0))
    return usual * 0.5 ** max(0, int(np.ceil(np.log2(product / ACCURATE)))) if product > 0 else usual


def growth(context: Context, parameters: Parameters, theta: Array) -> tuple[float, float]:
    """The rate of growth of errors at the measured states (its mean over the trajectory in which they grow most), and
    this times the duration: the logarithm of the factor by which they grow."""
    model = context.model
    if not _may_be_stiff(model) or model.marginal or model.diffusions or model.events:  # which may undo what has grown
        return 0.0, 0.0
    problem, states = _at_data(context, parameters, theta)
    packed, worst = problem.packed, (0.0, 0.0)
    for k, item in enumerate(context.trajectories.items[:LOOKED_AT]):
        rows = np.flatnonzero(packed.row_trajectory == k)
        modes = _modes(problem, parameters, theta, states, rows[:: max(1, len(rows) // MOST_ROWS)])
        rate = float(modes.real.max(axis=1).mean()) if len(modes) else 0.0
        worst = max(worst, (rate, rate * (item.end - item.start)), key=lambda each: each[1])
    return worst


def _at_data(context: Context, parameters: Parameters, theta: Array) -> tuple[Problem, Array]:
    """The problem, and the states [R, n_states] at its key rows by the curves through the data."""
    problem = context.problem()
    curves = imputed_forcing(context, problem)
    starts = parameters.starts(torch.from_numpy(theta)).numpy()
    return problem, np.where(curves.weight > 0, curves.value, starts[problem.packed.row_trajectory])


def _fastest(problem: Problem, parameters: Parameters, theta: Array, states: Array, rows: Integers) -> Array:
    """The rates of the fastest modes at the states [R, n_states] of some key rows, as from `decays`."""
    modes = _modes(problem, parameters, theta, states, rows)
    if not modes.size:
        return np.zeros(0)
    fastest = modes[np.arange(len(modes)), np.abs(modes).argmax(axis=1)]
    return np.where(fastest.real < 0, np.abs(fastest), 0.0)


def _modes(
    problem: Problem, parameters: Parameters, theta: Array, states: Array, rows: Integers
) -> NDArray[np.complex128]:
    """The eigenvalues of the Jacobian of the equations at some key rows, where it is finite."""
    packed, vector = problem.packed, torch.from_numpy(theta)
    owner = packed.row_trajectory[rows]
    constants = tuple(parameters.constants(vector)[owner].unbind(1))
    networks = problem.module.torch_networks(parameters.weights(vector))
    condition = torch.from_numpy(packed.condition)[owner]
    rhs = problem.module.equations.field(torch_arithmetic(problem.module), condition, constants, networks)
    at = map(torch.from_numpy, (packed.row_time[rows], states[rows], packed.row_inputs[rows]))
    found = rate_slopes(rhs, *at).detach().numpy()
    found = found[np.isfinite(found).all(axis=(1, 2))]
    return np.asarray(np.linalg.eigvals(found) if found.size else np.zeros((0, 0)), dtype=np.complex128)


def times_step(
    context: Context, problem: Problem, parameters: Parameters, theta: Array, fraction: float, states: Array
) -> tuple[float, float]:
    """The rate of the fastest decay at a tenth of the `states` [R, n_states] of solutions, and this times the fixed
    step; zeros where steps are adaptive, or where nothing is said of stiffness."""
    if context.adaptive or not _may_be_stiff(context.model):
        return 0.0, 0.0
    rows = np.arange(problem.packed.rows)[:: max(1, problem.packed.rows // MOST_ROWS)]
    rates = _fastest(problem, parameters, theta, states, rows[np.isfinite(states[rows]).all(axis=1)])
    fast = _usual(rates)
    return fast, fast * context.max_step * fraction


def unstable_as_learned(context: Context, parameters: Parameters, theta: Array) -> list[str]:
    """A sentence if errors grow so much within a trajectory that no whole solution can follow the data."""
    rate, product = growth(context, parameters, theta)
    if not product > HOPELESS:
        return []
    return [
        f"the equations are unstable at the data: errors grow at a rate of {rate:.3g}, by a factor of "
        f"1e{product / np.log(10):.0f} within a trajectory, so that no solution from an initial state can follow them, "
        f"whatever the constants. Cut the trajectories into pieces no longer than {SHORT / rate:.2g} (by names in the "
        "column `trajectory`; each has its own start), or describe disturbances by `diffusion`, with which rows are "
        "predicted from those before"
    ]


def stiff_as_learned(
    context: Context, problem: Problem, parameters: Parameters, theta: Array, fraction: float, states: Array
) -> list[str]:
    """A sentence if the equations are stiff for the fixed steps of a fit at its `states` [R, n_states], as learned: the
    slope of a function does not show before the fit, and constants may have moved to where steps are just stable."""
    fast, product = times_step(context, problem, parameters, theta, fraction, states)
    step = context.max_step * fraction
    remedy = f"fit again with `--solver {STIFF.name}`, or with a smaller `--max-step`"
    times = f"rates of {fast:.3g}, which times the step of {step:.3g} is {product:.3g}"
    if product > LIMIT:
        return [
            f"as learned, the equations are stiff: at its solutions they have {times}, and an explicit method is "
            f"stable up to {LIMIT}; {remedy}"
        ]
    if product > NEAR * LIMIT and not context.model.networks and context.options.max_step is None:
        return [
            f"the solutions are at the limit of the solver's stability: they have {times}, and an explicit method is "
            f"stable up to {LIMIT}. Constants may be where they are for this reason, and their intervals too narrow; "
            f"{remedy}"
        ]
    return []


def _may_be_stiff(model: Model) -> bool:
    """Whether the stiff solver is offered for a model, and needed where its equations are stiff."""
    exactly = model.diffusions and linear_in_states(model) is not None
    return not (exactly or model.delays)
