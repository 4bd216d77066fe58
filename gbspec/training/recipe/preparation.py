"""The initial vector: scales of the networks, constants from elimination, weights from slope regression."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from gbspec.arrays import Array, Mask
from gbspec.backends import GeneratedModule
from gbspec.data import Trajectories, sobol, spread_over_ranges
from gbspec.diagnostics import ComputationError
from gbspec.ir import Model
from gbspec.training.engines import residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Bijections, Parameters, Weights, mean_loss, typical
from gbspec.training.recipe.context import Context, build_context
from gbspec.training.recipe.judging import FEW
from gbspec.training.recipe.sized_networks import sized_networks
from gbspec.training.recipe.solved_states import with_solved_states
from gbspec.training.recipe.stages import imputed_forcing
from gbspec.training.recipe.weighing import first as first_weights
from gbspec.training.stages import StageName
from gbspec.training.starts import (
    Earlier,
    Eliminated,
    Points,
    collocate,
    curve_kinds,
    earlier,
    eliminate,
    network_scales,
    regress_slopes,
    sized_starts,
    slope_mismatch,
    unseen_outputs,
    unsized,
)

SUSPECT = 0.03
"""Other curves are tried above this typical residual (in standard deviations of the data) with interpolating curves."""
UNLIKE = 0.1
"""Other starts of the constants are tried above this mean loss between rows (R² below 0.8), where values are few."""
PLACES = 6
"""So many starts of the constants are tried, spread over their ranges."""
TRIED = 10
"""From each of them this many iterations are tried."""
RIDGE = 1e-2
"""The first ridge of these; the evidence changes it."""
CLEARLY = 0.7
"""One of them is taken if it leaves less than this of the loss: the declared start may be what is known."""


@dataclass(frozen=True)
class Prepared:
    """A member before its first stage. `loss`: mean of half squared residuals with imputed forcing; `fraction`: the
    step over the default one."""

    context: Context
    parameters: Parameters
    theta: Array
    loss: float
    fraction: float = 1.0


def prepare(
    model: Model, module: type[GeneratedModule], trajectories: Trajectories, options: TrainOptions, seed: int
) -> Prepared:
    """The context and the initial vector, from interpolating curves, or from other ones if these give a better fit.

    With `--start` the networks and constants of an earlier run replace those that have their names.
    """
    given = None if options.start is None else earlier(options.start, model, module)
    first = _attempt(_weighed(_sized(build_context(model, module, trajectories, options, seed))), given)
    if given is not None or not options.warm_start or not first.context.points.equations:
        return first
    if _misfit(first) <= SUSPECT:
        return first
    kinds = curve_kinds(model, first.context.curves)
    others = [build_context(model, module, trajectories, options, seed, kind) for kind in kinds]
    best = min(first, *(_attempt(_weighed(_sized(other))) for other in others), key=_misfit)
    return _from_other_constants(best)


def _from_other_constants(found: Prepared) -> Prepared:
    """The same, or the preparation from other starts of the constants if slopes and curves are clearly better met.

    Slopes tell constants from functions only within a factor of their starts, and functions have the size that they
    had beside these: where both are wrong, no later stage leads to the others.
    """
    context = found.context
    model, learnables = context.model, context.model.learnables
    values = int((context.packed().weights > 0).sum())
    plain = bool(learnables and model.networks) and not (model.distributed or model.diffusions)
    plain = plain and context.options.method == "auto" and context.options.ridge is None
    if not plain or values >= FEW or not found.loss > UNLIKE:
        return found
    drawn = spread_over_ranges(learnables, sobol(PLACES, len(learnables), context.seed))
    starts = [Bijections.of(learnables).from_natural(natural) for natural in drawn]
    tried = [_improved(Prepared(context, *_sized_initial(context, start), np.inf)) for start in starts]
    best, same = min(tried, key=lambda one: one.loss), _improved(found)
    best = best if best.loss < CLEARLY * same.loss else same
    return best if best.loss < CLEARLY * found.loss else found


def _improved(found: Prepared) -> Prepared:
    """The same after a few iterations of Levenberg-Marquardt with imputed forcing."""
    context, problem = found.context, found.context.problem()
    imputed = replace(problem, forcing=imputed_forcing(context, problem))
    engine = context.choice.engine(imputed, found.parameters)
    stage = LevenbergMarquardt(
        StageName.IMPUTED.value, TRIED, lambda i: engine, LevenbergOptions(ridge=RIDGE, evidence=True)
    )
    state, loss = stage.begin(found.theta), found.loss
    for i in range(TRIED):
        try:
            outcome = stage.step(state, i)
        except ComputationError:
            break
        state, loss = outcome.state, outcome.loss
        if outcome.done:
            break
    return replace(found, theta=state["theta"], loss=loss)


def at_step(found: Prepared, fraction: float) -> Prepared:
    """The same at `fraction` of the largest step."""
    made = replace(found, context=found.context.finer(fraction), fraction=fraction)
    return replace(made, loss=mean_loss(_imputed_residuals(made.context, made.parameters, made.theta)))


def _weighed(context: Context) -> Context:
    """The context with first weights of channels that have very different numbers of values."""
    context.estimated = first_weights(context)
    return context


def _sized(context: Context) -> Context:
    """The context with the sizes and initial values of states of which nothing but whole solutions tells them.

    Not with networks, whose scales take part in it.
    """
    model = context.model
    if model.networks or model.diffusions or model.distributed or model.steady is not None:
        return context
    covered = np.array([context.curves.covers(i) for i in range(len(model.states))], dtype=np.bool_)
    states = unsized(model, covered, context.start_free)
    if not states.any():
        return context
    parameters, theta = initial(context)
    found = sized_starts(context.engine(parameters, 0.0), theta, states, context.seed)
    if found is not None:
        starts, sizes = found
        context.start_value = np.where(states & (context.start_free > 0), starts, context.start_value)
        context.state_scale = np.where(states, sizes, context.state_scale)
        context.points = collocate(model, context.trajectories, context.curves, context.start_value)
        context.unsized = states
    return context


def _misfit(prepared: Prepared) -> float:
    """Typical residual of the solution that restarts from the curves at every row."""
    return typical(_imputed_residuals(prepared.context, prepared.parameters, prepared.theta))


def _imputed_residuals(context: Context, parameters: Parameters, theta: Array) -> Array:
    """Residuals under imputed forcing: every state is reset to its curve, if it has one, at every key row."""
    problem = context.problem()
    imputed = replace(problem, forcing=imputed_forcing(context, problem))
    return residual_vector(context.choice.engine(imputed, parameters), theta)


def _attempt(context: Context, given: Earlier | None = None, start: Array | None = None) -> Prepared:
    parameters, theta = _sized_initial(context, start)
    if context.options.warm_start and (given is None or not set(parameters.weight_shapes) <= set(given.weights)):
        theta = regress_slopes(parameters, context.module, context.points, theta, context.seed)
    if given is not None:
        parameters, theta = _started(context, parameters, theta, given)
    return Prepared(context, parameters, theta, mean_loss(_imputed_residuals(context, parameters, theta)))


def _started(context: Context, parameters: Parameters, theta: Array, given: Earlier) -> tuple[Parameters, Array]:
    """The layout and the vector with what an earlier run has of them; the rest is as it was."""
    fixed = {name: given.weights.get(name, value) for name, value in parameters.fixed.items()}
    layout, vector = replace(parameters, fixed=fixed), torch.from_numpy(theta)
    weights = {name: value.numpy() for name, value in parameters.weights(vector).items()}
    natural = parameters.constants(vector).numpy()[:, len(context.model.constants) :]
    return layout, layout.vector(weights | given.weights, given.natural(context.model, natural))


LAGS = 6
"""So many values of the learned constants in delays are tried, spread over their bounds."""


def _eliminated(context: Context, points: Points, start: Array) -> Eliminated:
    """Constants and free outputs from the slopes of the curves.

    Slopes have several best delays, of which the nearest one is found. Where all forms are known, delays are therefore
    also started from other values, and the result whose balances agree best is taken.
    """
    model, module = context.model, context.module
    first = eliminate(model, module, points, start)
    in_delays = {s for delay in model.delays for s in delay.lag.free_symbols}
    lags = [i for i, k in enumerate(model.learnables) if k.symbol in in_delays]
    if model.networks or not lags or not context.options.warm_start:
        return first
    shares = sobol(LAGS, len(lags), context.seed)
    drawn = spread_over_ranges(tuple(model.learnables[i] for i in lags), shares)
    found = [first]
    for values in drawn:
        natural = np.array([k.start for k in model.learnables], dtype=np.float64)
        natural[lags] = values
        found.append(eliminate(model, module, points, Bijections.of(model.learnables).from_natural(natural)))
    return min(found, key=lambda one: slope_mismatch(model, module, points, one.constants))


def initial(context: Context) -> tuple[Parameters, Array]:
    """Random weights and networks scaled by the data; constants as declared, or from elimination (warm start)."""
    parameters, theta, _ = _scaled(context)
    return parameters, theta


def _sized_initial(context: Context, start: Array | None) -> tuple[Parameters, Array]:
    """The same; of outputs that act on unmeasured states alone, whole solutions tell the size."""
    parameters, theta, unseen = _scaled(context, start)
    if not context.options.warm_start or not any(mask.any() for mask in unseen.values()):
        return parameters, theta
    return sized_networks(context, parameters, theta, unseen)


def _scaled(context: Context, start: Array | None = None) -> tuple[Parameters, Array, dict[str, Mask]]:
    """The layout and vector of `initial`, and the outputs of networks of which no slope tells the size."""
    model = context.model
    learnables = Bijections.of(model.learnables)
    if start is None:
        start = learnables.from_natural(np.array([k.start for k in model.learnables], dtype=np.float64))
    fixed: Weights = {
        name: value for name, value in context.module.weights.items() if name.endswith(("_center", "_scale"))
    }
    constants, unseen = start, dict[str, Mask]()
    if len(context.points):
        natural = learnables.to_natural(torch.from_numpy(start)).numpy() if len(start) else start
        eliminated = _eliminated(context, with_solved_states(context, natural), start)
        fixed = network_scales(model, eliminated)
        unseen = unseen_outputs(model, eliminated)
        if context.options.warm_start and np.isfinite(eliminated.constants).all():
            constants = eliminated.constants
    factor = context.options.output_scale
    parameters = context.parameters({k: factor * v if k.endswith("output_scale") else v for k, v in fixed.items()})
    natural = learnables.to_natural(torch.from_numpy(constants)).numpy() if len(constants) else constants
    return parameters, parameters.vector(context.module.weights, natural), unseen
