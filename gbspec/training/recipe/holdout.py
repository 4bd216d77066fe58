"""The error of a vector on held-out data, with shared parameters fixed and each trajectory's own ones fitted to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, predicted, residual_vector
from gbspec.training.population import Marginal, modes_of
from gbspec.training.problem import Parameters, Problem, mean_loss, teacher_forcing
from gbspec.training.recipe.context import Context, start_states
from gbspec.training.recipe.disturbed import held_out_likelihood
from gbspec.training.starts import fit_curves, refit_starts


def held_out_score(context: Context, parameters: Parameters, theta: Array, fraction: float = 1.0) -> float:
    """Mean of half squared residuals of the held-out trajectories under teacher forcing (infinite if not finite).

    With the `fraction` of the largest step that `theta` is fitted with. Of models that are fitted by a likelihood it is
    the negative log likelihood of the held-out values, over their number; of a population by Laplace's method.

    A single trajectory of which the last rows are held out is solved from its fitted initial state; only these rows
    count.
    """
    if context.model.diffusions:
        return held_out_likelihood(context, parameters, theta)
    if context.model.marginal:
        return _held_out_marginal(context, parameters, theta, fraction)
    engine, vector = _fitted(context, parameters, theta, 1.0, fraction)
    return mean_loss(residual_vector(engine, vector))


def _held_out_marginal(context: Context, parameters: Parameters, theta: Array, fraction: float) -> float:
    engine, vector = _fitted(context, parameters, theta, 0.0, fraction)
    marginal = Marginal.of(engine.problem, engine.parameters, context.choice)
    z = modes_of(engine.parameters, marginal.likelihood, vector)
    found = marginal.value(vector[marginal.layout.slice()], vector[: parameters.n_weights], z, True).total
    return found / (2 * max(int(engine.problem.seen.sum()), 1)) if np.isfinite(found) else float("inf")


def held_out_solutions(
    context: Context, parameters: Parameters, theta: Array, fraction: float = 1.0
) -> tuple[Problem, Array] | None:
    """The problem of the held-out data, and its predictions [R, C] by whole solutions; None if nothing is held out."""
    if not len(context.held):
        return None
    engine, vector = _fitted(context, parameters, theta, 0.0, fraction)
    return engine.problem, predicted(engine, vector).mean


def _fitted(
    context: Context, parameters: Parameters, theta: Array, blend: float, fraction: float
) -> tuple[Engine, Array]:
    """The engine of the held-out data, with the vector in which their own parameters are fitted."""
    held, model = context.held, context.model
    packed = context.pack(held, fraction)
    scaling = context.scaling(packed)
    single = len(held) == 1 and held.items[0].label == context.trajectories.items[0].label
    if single:  # only the rows that are not fitted count
        earlier = (packed.row_time <= context.trajectories.items[0].end)[:, None]
        packed = replace(packed, weights=np.where(earlier, 0.0, packed.weights))
    forcing = teacher_forcing(model, packed, 0.0 if single else blend)
    problem = replace(context.posed(packed, forcing, fraction), scaling=scaling)
    value, free = start_states(model, held, fit_curves(model, held), packed)
    local = replace(parameters, start_value=value, start_free=free)
    own = theta[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
    block = np.tile(own.mean(axis=0), (len(held), 1))
    block[:, len(parameters.own) :] = own[0, len(parameters.own) :] if single else 0.0
    vector = np.concatenate([theta[: parameters.n_shared], block.ravel()])
    if single:
        same = replace(local, start_value=parameters.start_value, start_free=parameters.start_free)
        return context.choice.engine(problem, same), vector
    engine = context.choice.engine(problem, local)
    return engine, refit_starts(engine, vector, context.seed)
