"""What a member's directory keeps of a fit's certainty: the covariance of its parameters, and where its unknowns were
trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, network_arguments
from gbspec.data import Trajectories, Trajectory, evenly_spaced
from gbspec.runs import Certainties, Support
from gbspec.training.engines import Engine, predicted
from gbspec.training.optimise import ON_THE_WAY, covariance
from gbspec.training.problem import Parameters, Problem
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.summary import whole_solutions
from gbspec.training.stages import StageName

POINTS = 2000
"""The most points that are kept for a network."""
BETWEEN = 3
"""Times between two rows, and between the start and the first row, at which networks are looked at too: solutions pass
there, and inputs change."""


def certainties(
    context: Context, parameters: Parameters, theta: Array, stages: Sequence[str], member: GeneratedModule
) -> Certainties:
    """The certainty of a finished fit at `theta`, from residuals as its last stages saw them; `member` has its
    weights. That of a marginal likelihood has its covariance from elsewhere."""
    marginal = context.model.marginal
    blend = 0.0 if marginal or whole_solutions(context, parameters, stages) else context.options.blend
    engine = context.engine(parameters, blend, step_fraction(stages))
    # Least squares fit models whose functions are all known, unless Levenberg-Marquardt alone was asked for.
    robust = bool(context.model.networks) or context.options.method == "lm"
    asked = {StageName.AS_ASKED, StageName.LEVENBERG_MARQUARDT} & set(stages)
    most = np.inf if asked or not blend else ON_THE_WAY  # that of predictions from row to row ends as it went on
    known = None if marginal else covariance(engine, theta, robust, most)
    if member.networks and engine.problem.packed.rows < POINTS:
        dense = replace(context, trajectories=_dense(context.trajectories), _packed={})
        engine = dense.engine(parameters, blend, step_fraction(stages))
    return Certainties(known, support(engine, theta, member))


def _dense(trajectories: Trajectories) -> Trajectories:
    """The trajectories with rows without measurements between theirs."""
    return replace(trajectories, items=tuple(_with_times_between(item) for item in trajectories.items))


def _with_times_between(item: Trajectory) -> Trajectory:
    ends = np.unique(np.concatenate([[item.start], item.times[item.times >= item.start]]))
    shares = np.arange(1, BETWEEN + 1) / (BETWEEN + 1)
    more = np.concatenate([ends[:1], (ends[:-1, None] + np.diff(ends)[:, None] * shares).ravel()])
    times = np.union1d(item.times, more)
    place = np.searchsorted(times, item.times)

    def spread(table: Array, empty: float) -> Array:
        out = np.full((len(times), table.shape[1]), empty)
        out[place] = table
        return out

    return replace(
        item,
        times=times,
        values=spread(item.values, np.nan),
        counts=spread(item.counts, 0.0),
        sd=spread(item.sd, np.nan),
        limits=None,
        scatter=None,
    )


def support(engine: Engine, theta: Array, member: GeneratedModule) -> dict[str, Support]:
    """For each network the arguments with which it is called at the rows of the problem, at most `POINTS` of them."""
    if not member.networks:
        return {}
    moments = predicted(engine, theta)
    return support_of(engine.problem, engine.parameters, theta, (moments.before, moments.after), member)


def support_of(
    problem: Problem, parameters: Parameters, theta: Array, states: tuple[Array, Array], member: GeneratedModule
) -> dict[str, Support]:
    """The same from the states before and after the arrivals at the key rows."""
    if not member.networks:
        return {}
    packed, (before, after) = problem.packed, states
    with torch.no_grad():
        own = parameters.constants(torch.from_numpy(theta)).numpy()
    rows = np.flatnonzero(np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1))
    # An arrival, such as a dose, moves a state to where no measurement is: both sides of it were trained on.
    moved = rows[np.any(before[rows] != after[rows], axis=1)]
    row, points_at = np.concatenate([rows, moved]), np.concatenate([before[rows], after[moved]])
    chosen = evenly_spaced(len(row), POINTS)
    row, points_at = row[chosen], points_at[chosen]
    owner = packed.row_trajectory[row]
    calls = network_arguments(
        member, packed.row_time[row], points_at, packed.condition[owner], packed.row_inputs[row], own[owner]
    )
    found = {}
    for network, each in zip(parameters.model.networks, calls, strict=True):
        points = np.concatenate([np.zeros((0, len(network.arguments))), *each])
        owners = np.tile(owner, len(each))
        good = np.flatnonzero(np.isfinite(points).all(axis=1))
        good = good[:: max(1, -(-len(good) // POINTS))]
        found[network.name] = Support(points[good], owners[good].astype(np.float64))
    return found
