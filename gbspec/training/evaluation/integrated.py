"""The likelihood where it is an integral: over what is distributed between trajectories, or over random disturbances.

A population has its marginal likelihood, by Laplace's method, with residuals at the modes; a model with `diffusion`
that of the innovations of its filter, whose errors of one-step predictions are the residuals. Steps are halved until
neither the likelihood nor its gradient changes by more than `ACCURACY`, relative to its size; where they would have to
be too short for a disturbed model, it is solved with the stiff solver, and smaller and smaller tolerances. Densities
are those of measured values themselves, also under lognormal noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from gbspec.arrays import Array, Mask, as_measured
from gbspec.backends import GeneratedModule, load_module
from gbspec.data import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.ir import STIFF, Model, linear_in_states
from gbspec.training.engines import FilterEngine, happened
from gbspec.training.evaluation.lacking import Lacking
from gbspec.training.evaluation.point import ACCURACY, Evaluated, Given, Value, change, ordered
from gbspec.training.options import TrainOptions
from gbspec.training.population import Layout
from gbspec.training.problem import Bijections, Integers, Parameters
from gbspec.training.recipe import Context, build_context, marginal_objective
from gbspec.training.stages import StageName

HALVINGS, TENTHS = 7, 2
"""So often the step is halved at most; of disturbed models that are stiff the tolerance becomes a tenth."""
COARSE = 1e-6
"""A change above which the stiff solver is tried too."""
LIMITS = {-1: "<", 1: ">", 0: ""}


def evaluate_integral(model: Model, trajectories: Trajectories, given: Given) -> Evaluated:
    """The objective of a population or of a model with disturbances. Raises ComputationError without a solution."""
    best = _settled(model, trajectories, given, load_module(model), HALVINGS)
    coarse = best is None or best.accuracy > COARSE
    if coarse and model.diffusions and linear_in_states(model) is None:
        stiff = _settled(model, trajectories, given, load_module(model, STIFF), TENTHS)
        best = min((one for one in (best, stiff) if one is not None), key=lambda one: one.accuracy, default=None)
    if best is None:
        raise ComputationError(
            "the likelihood is not finite at these constants",
            where=f"the model {model.name}",
            remedy="other constants by `--set`, or `gbspec simulate`, which says where a solution ends",
        )
    return replace(best, gradient=best.lacking.without(best.gradient))


def _settled(
    model: Model, trajectories: Trajectories, given: Given, module: type[GeneratedModule], halvings: int
) -> Evaluated | None:
    """The objective with steps so short that it stays, or the best that there is; None without a solution."""
    options = TrainOptions(device="cpu", solver=module.solver)
    context = build_context(model, module, trajectories, options, 0)
    if model.networks:
        context.module = module(dict(given.weights))
    fixed = {k: v for k, v in given.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = replace(context.parameters(fixed), start_value=given.starts)
    judged = _filtered if model.diffusions else _marginal
    previous: Evaluated | None = None
    best: Evaluated | None = None
    for number in range(halvings + 1):
        found = judged(context, parameters, given, number)
        if found is None:
            previous = None
            continue
        if previous is not None:
            found = replace(found, accuracy=min(found.accuracy, change(previous, found)))
        if best is None or found.accuracy <= best.accuracy:
            best = found
        if found.accuracy <= ACCURACY:
            return found
        previous = found
    return best


def parameters_of(model: Model, known: Mapping[str, float]) -> dict[str, float]:
    """The natural parameters of a population: `known` ones, else the starts; medians have the names of their
    constants, and all others (spreads `sd_NAME`, correlations, noises) their own."""
    medians = {k.distribution.median: k for k in model.distributed if k.distribution is not None}
    found = {}
    for one in (*model.learnables, *model.implied):
        declared = medians.get(one.name, one)
        found[one.name] = known.get(one.name, known.get(declared.name, declared.start))
    return found


# ------------------------------------------------------------------------------------------------------- populations
def _marginal(context: Context, parameters: Parameters, given: Given, halvings: int) -> Evaluated | None:
    layout, model = Layout(parameters), context.model
    objective = marginal_objective(context, parameters, [StageName.FINER.value] * halvings)
    marginal = objective.marginal
    natural = np.array([given.population[k.name] for k in layout.each], dtype=np.float64)
    u, weights = layout.bijections.from_natural(natural), _weights(parameters, given)
    begun = np.zeros((marginal.likelihood.count, marginal.likelihood.groups.size))
    value = marginal.value(u, weights, begun, afresh=True)
    if not np.isfinite(value.total):
        return None
    beside = layout.bijections.inside(u)
    slopes = marginal.slopes(beside, weights, value.z).parameters.sum(axis=0) / 2
    slopes = slopes / layout.bijections.derivative(beside)
    of = marginal.likelihood.at(layout.natural(marginal.rows(u)), torch.from_numpy(value.z), weights)
    measured, problem = marginal.predictions.measured, marginal.predictions.problem
    mean, sd = of.mean.detach().numpy(), np.sqrt(of.variance.detach().numpy())
    residual = of.residual.detach().numpy() / sd
    limited = measured.side != 0
    residual[limited] = _limited(residual[limited], measured.side[limited])
    row, _ = np.nonzero(problem.seen)
    values = _values(context, measured.owner, problem.packed.row_time[row], measured.channel, measured.logarithm,
                     mean, measured.value, sd, residual, measured.side)  # fmt: skip
    medians = {k.distribution.median: k.name for k in model.distributed if k.distribution is not None}
    gradient = {medians.get(k.name, k.name): float(g) for k, g in zip(layout.each, slopes, strict=True)}
    chi2 = float(np.sum(residual**2))
    individuals = marginal.predictions.individuals
    constants, _ = marginal.likelihood.individual(layout.natural(marginal.rows(u)), torch.from_numpy(value.z))
    events = happened(individuals.engine, individuals.vector(constants.detach().numpy(), weights))
    slides = context.cutting and events is not None and bool(events.uncut.any())
    lacking = Lacking.of(model, context.switched, slides)
    way = f"{context.module.solver}, Laplace's method" if model.distributed else context.module.solver
    return Evaluated(value.total / 2, chi2, gradient, values, np.inf, way, lacking)


def _limited(residual: Array, side: Array) -> Array:
    """What stands for the residuals of limits: half its square is minus the logarithm of the probability."""
    from scipy.special import log_ndtr

    return np.asarray(-side * np.sqrt(-2 * log_ndtr(side * residual)), dtype=np.float64)


# ------------------------------------------------------------------------------------------------------ disturbances
def _filtered(context: Context, parameters: Parameters, given: Given, halvings: int) -> Evaluated | None:
    problem = context.problem(0.0, 0.5**halvings)
    engine = FilterEngine.of(problem, parameters)
    log_sd, channels = engine.noise.first(), context.model.channels
    for place, channel in enumerate(engine.noise.learned):
        log_sd[place] = np.log(given.noise[channels[channel].name])
    theta = parameters.vector(given.weights, given.constants)
    vector = np.concatenate([theta, log_sd])
    found = engine.filtered(vector)
    if not found.finite:
        return None
    places, beside = slice(parameters.n_weights, parameters.n_shared), vector.copy()
    beside[places] = parameters.bijections(parameters.shared).inside(vector[places])
    there = found if np.array_equal(beside, vector) else engine.filtered(beside)
    slopes, seen, log = engine.information(beside, there).gradient, found.seen, engine.noise.log
    row, channel = np.nonzero(seen)
    sd = np.sqrt(found.variance[row, channel])
    residual = -found.error[row, channel] / sd
    measured, logs = engine.noise.value[row, channel], log[channel]
    values = _values(context, problem.packed.row_trajectory[row], problem.packed.row_time[row], channel, logs,
                     found.mean[row, channel], measured, sd, residual, np.zeros(len(row)))  # fmt: skip
    nllh = found.value + float(measured[logs].sum())
    gradient = _shared_slopes(parameters, beside[: parameters.size], slopes)
    exact = 0.0 if engine.exact is not None else np.inf
    lacking = Lacking.of(context.model, context.switched, slides=False)
    return Evaluated(nllh, float(np.sum(residual**2)), gradient, values, exact, "the filter of disturbances", lacking)


def _shared_slopes(parameters: Parameters, theta: Array, slopes: Array) -> dict[str, float]:
    """The derivatives by constants in their units; of those of single trajectories the sum over all."""
    model, found = parameters.model, {}
    span = slice(parameters.n_weights, parameters.n_shared)
    rates = slopes[span] / parameters.bijections(parameters.shared).derivative(theta[span])
    found = {model.learnables[i].name: float(rate) for i, rate in zip(parameters.shared, rates, strict=True)}
    if parameters.own:
        shape = (parameters.trajectories, parameters.n_local)
        local, at = (part[parameters.n_shared : parameters.size].reshape(shape) for part in (slopes, theta))
        own: Bijections = parameters.bijections(parameters.own)
        each = local[:, : len(parameters.own)] / own.derivative(at[:, : len(parameters.own)].copy())
        found |= {
            model.learnables[i].name: float(total) for i, total in zip(parameters.own, each.sum(axis=0), strict=True)
        }
    return {k.name: found[k.name] for k in model.learnables if k.name in found}


# -------------------------------------------------------------------------------------------------------------- both
def _weights(parameters: Parameters, given: Given) -> Array:
    shapes = parameters.weight_shapes
    return np.concatenate([np.zeros(0), *(np.ravel(given.weights[name]) for name in shapes)])


def _values(
    context: Context, owner: Integers, time: Array, channel: Integers, logs: Mask, mean: Array, measured: Array,
    sd: Array, residual: Array, side: Array,
) -> tuple[Value, ...]:  # fmt: skip
    labels, names = context.packed().labels, [c.name for c in context.model.channels]
    predicted, known = as_measured(mean, logs), as_measured(measured, logs)
    return tuple(
        Value(
            labels[owner[i]], float(time[i]), names[channel[i]], float(predicted[i]), float(known[i]), float(sd[i]),
            float(residual[i]), LIMITS[int(side[i])],
        )
        for i in ordered(owner, time, channel)
    )  # fmt: skip
