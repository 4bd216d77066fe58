"""The error of a vector on held-out data, with shared parameters fixed and each trajectory's own ones fitted to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.engines import residual_vector
from gbspec.training.problem import Parameters, Problem, mean_loss, pack, scaling_of, teacher_forcing
from gbspec.training.recipe.context import Context, start_states
from gbspec.training.starts import fit_curves, refit_starts


def held_out_score(context: Context, parameters: Parameters, theta: Array) -> float:
    """Mean of half squared residuals of the held-out trajectories under teacher forcing (infinite if not finite).

    A single trajectory of which the last rows are held out is solved from its fitted initial state; only these rows
    count.
    """
    held, model = context.held, context.model
    packed = pack(held, model, context.max_step, method=context.method)
    scaling = scaling_of(model, packed, context.trajectories)
    single = len(held) == 1 and held.items[0].label == context.trajectories.items[0].label
    forcing = teacher_forcing(model, packed, 0.0 if single else 1.0)
    problem = Problem(model, context.module, packed, forcing, scaling)
    value, free = start_states(model, held, fit_curves(model, held), packed)
    local = replace(parameters, start_value=value, start_free=free)
    own = theta[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
    block = np.tile(own.mean(axis=0), (len(held), 1))
    block[:, len(parameters.own) :] = own[0, len(parameters.own) :] if single else 0.0
    vector = np.concatenate([theta[: parameters.n_shared], block.ravel()])
    if single:
        later = packed.row_time > context.trajectories.items[0].end
        same = replace(local, start_value=parameters.start_value, start_free=parameters.start_free)
        return mean_loss(residual_vector(context.choice.engine(problem, same), vector)[_of_rows(problem, later)])
    engine = context.choice.engine(problem, local)
    return mean_loss(residual_vector(engine, refit_starts(engine, vector, context.seed)))


def _of_rows(problem: Problem, rows: Mask) -> Mask:
    """The mask of the measured residuals that belong to the given rows."""
    where = np.nonzero(problem.packed.weights > 0)[0]
    return np.asarray(rows[where], dtype=np.bool_)
