"""The cause of a solution that is not finite: the trajectory, the time, and the balance."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import Value
from gbspec.diagnostics import ComputationError
from gbspec.ir import without_values
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.starting import initial_or_failure
from gbspec.training.engines.torch.planning import planned
from gbspec.training.engines.torch.segments import Schedule
from gbspec.training.engines.torch.sub_steps import Deliveries, advance, cutting, sub_step
from gbspec.training.engines.torch.unroll import unroll
from gbspec.training.problem import Parameters, Problem

_REMEDY = (
    "a smaller `--max-step`, bounds on the learned constants (`learn k = 1 in [0, 10]`), "
    "or a range and a start for each state (`state x in [0, 1] = 0.5`)"
)


def explain_failure(problem: Problem, parameters: Parameters, theta: Array, stage: str) -> ComputationError:
    """The error to raise if the solution at `theta` is not finite."""
    packed = problem.packed
    if not np.isfinite(theta).all():
        return ComputationError(
            f"the parameters are no longer numbers in stage `{stage}`",
            remedy="lower `--learning-rate`, or use `--method auto`",
        )
    with torch.no_grad():
        search = _first_row if problem.model.delays else _first_failure
        found = search(problem, parameters, theta)
    ends = without_values({table.name: table.curve for table in problem.model.tables})
    remedy = f"{_REMEDY}; {ends}" if ends else _REMEDY
    if found is None:
        return ComputationError(f"a residual is not a finite number in stage `{stage}`", remedy=remedy)
    trajectory, time, term, state = found
    values = ", ".join(f"{s.name} = {v:.6g}" for s, v in zip(problem.model.states, state, strict=True))
    return ComputationError(
        f"the solution blew up in stage `{stage}`: {term}",
        where=f"trajectory `{packed.labels[trajectory]}` at {problem.model.time.name} = {time:.6g}, where {values}",
        remedy=remedy,
    )


def _first_failure(problem: Problem, parameters: Parameters, theta: Array) -> tuple[int, float, str, Array] | None:
    """The first trajectory and time whose state is not finite, the responsible balance, and the last finite state."""
    module, m, vector = problem.module, torch_arithmetic(problem.module), torch.from_numpy(theta)
    path = Paths(problem, planned).at(parameters, theta)
    packed, names = path.packed, [s.name for s in problem.model.states]
    networks = module.torch_networks(parameters.weights(vector))
    constants = parameters.constants(vector)
    k = tuple(constants.unbind(1))
    c = torch.from_numpy(packed.condition)
    deliveries, rhs = Deliveries.of(problem, c, k), module.equations.field(m, c, k, networks)
    events = cutting(problem, c, k, networks, networks)
    x, unsteady = initial_or_failure(problem, parameters, vector, parameters.starts(vector), constants, networks)
    bad = ~torch.isfinite(x)
    if bad.any():
        i = int(torch.nonzero(bad)[0, 0])
        if i in unsteady:
            why = f"there is no steady start of `{unsteady[i][0]}`: {unsteady[i][1]}"
            return i, float(packed.start[i]), why, x[i].numpy()
        which = ", ".join(f"`{names[j]}`" for j in torch.nonzero(bad[i])[:, 0].tolist())
        return i, float(packed.start[i]), f"the initial state of {which} is not finite", x[i].numpy()
    everyone = np.arange(packed.trajectories)
    for s in range(packed.depth + 1):
        if s > 0:
            step = sub_step(problem, path, np.full(packed.trajectories, s - 1), everyone, x)
            going = torch.from_numpy(packed.steps >= s)
            new = torch.where(going[:, None], advance(x, step, deliveries, rhs, events), x)
            bad = ~torch.isfinite(new)
            if bad.any():
                i = int(torch.nonzero(bad.any(-1))[0, 0])
                slope = module.equations.rhs(m, step.t, x, c, step.nodes[0], k, networks)[i]
                why = events.trouble if events is not None and events.trouble else _blame(names, slope, bad[i])
                own = [value[i] if value.ndim else value for value in k]
                given = (step.t[i], c[i], step.nodes[0][i], tuple(own), networks)
                why = _unsolved(problem, given, x[i], x[i] + step.h[i] * slope) or why
                return i, float(packed.t[s - 1, i]), why, x[i].numpy()
            x = new
        here = np.flatnonzero(packed.row_step == s)
        weight, value = torch.zeros_like(x), torch.zeros_like(x)
        weight[packed.row_trajectory[here]] = torch.from_numpy(problem.forcing.weight[here])
        value[packed.row_trajectory[here]] = torch.from_numpy(problem.forcing.value[here])
        x = x - weight * (x - value)
    return None


def _unsolved(problem: Problem, given: tuple[Value, ...], *states: Tensor) -> str:
    """The algebraic equations without a solution at the first of these states where that is so; else empty."""
    if not problem.model.algebraics:
        return ""
    m, (t, condition, inputs, constants, networks) = torch_arithmetic(problem.module), given
    equations = problem.module.equations
    found = (equations.unsolved(m, t, x, condition, inputs, constants, networks) for x in states)
    return next((text for text in found if text), "")


def _first_row(problem: Problem, parameters: Parameters, theta: Array) -> tuple[int, float, str, Array] | None:
    """The same for a model with delays, whose steps need their past: the first row whose state is not finite, and the
    last finite state at a row."""
    path = Paths(problem, planned).at(parameters, theta)
    schedule = Schedule(problem, path, torch.float64, "cpu")
    out = unroll(problem, parameters, torch.from_numpy(theta), schedule)
    packed, before = problem.packed, out.before.numpy()
    bad = np.flatnonzero(~np.isfinite(before).all(axis=1))
    if not len(bad):
        return None
    row = int(bad[np.argmin(packed.row_time[bad])])
    who = int(packed.row_trajectory[row])
    earlier = np.flatnonzero((packed.row_trajectory == who) & (packed.row_time < packed.row_time[row]))
    last = before[earlier[np.argmax(packed.row_time[earlier])]] if len(earlier) else out.initial[who].numpy()
    return who, float(packed.row_time[row]), "a state is not finite, and was at the row before", np.asarray(last)


def _blame(names: list[str], rhs: Tensor, bad: Tensor) -> str:
    """The balances that are not finite at the last finite state, else those whose step diverges, in words."""
    broken = [names[j] for j in torch.nonzero(~torch.isfinite(rhs))[:, 0].tolist()]
    if broken:
        return "the right-hand side of " + ", ".join(f"`{n}'`" for n in broken) + " is not finite"
    diverging = torch.nonzero(bad)[:, 0].tolist()
    parts = ", ".join(f"`{names[j]}'` = {float(rhs[j]):.4g}" for j in diverging)
    return f"the step diverges in {parts}"
