"""The unrolled solver equals one trajectory after the other, stepped by hand; pieces are as long as they need to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gbspec.training.parameters import Parameters
from gbspec.training.pieces import cut
from gbspec.training.problem import Forcing, Problem
from gbspec.training.unroll import row_residuals, unroll
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data


def by_hand(problem: Problem, parameters: Parameters, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals [R, C] and states after resets [R, n_states]: every trajectory by itself, whole, step by step."""
    packed, module = problem.packed, problem.module
    networks = module.torch_networks(parameters.weights(theta))
    constants, starts = parameters.constants(theta), parameters.starts(theta)
    condition = torch.from_numpy(packed.condition)
    arrival: list[Tensor] = [torch.zeros(0)] * packed.rows
    departure = list(arrival)
    for i in range(packed.trajectories):
        c, k = condition[i : i + 1], tuple(constants[i : i + 1].unbind(1))
        x = module._initial(problem.ops, starts[i : i + 1], c, k)
        done = 0
        for row in np.flatnonzero(packed.row_trajectory == i):
            for s in range(done, packed.row_step[row]):
                t, h = (torch.from_numpy(table[s, i : i + 1]) for table in (packed.t, packed.h))
                nodes = torch.from_numpy(packed.inputs[s, i : i + 1]).unbind(1)
                x = module._step(problem.ops, t, x, h, c, nodes, k, networks)
            done = int(packed.row_step[row])
            arrival[row] = x[0]
            value, weight = (torch.from_numpy(table[row]) for table in (problem.forcing.value, problem.forcing.weight))
            x = x - weight * (x - value)
            departure[row] = x[0]
    owner = torch.from_numpy(packed.row_trajectory)
    return row_residuals(problem, torch.stack(arrival), constants[owner], networks), torch.stack(departure)


def imputed(problem: Problem) -> Problem:
    """Every state put in at every second row of a trajectory, none elsewhere."""
    weight = np.zeros_like(problem.forcing.weight) + (problem.packed.row_index % 2 == 0)[:, None]
    return replace(problem, forcing=Forcing(np.full_like(weight, 0.7), weight))


CASES = {
    "all states measured together": (URP, urp_data(4, 2.0, 6, together=True), 0.1, 1.0),
    "states measured apart": (URP, urp_data(4, 2.0, 6), 0.1, 1.0),
    "a blend": (URP, urp_data(4, 2.0, 6, together=True), 0.1, 0.5),
    "autoregressive": (URP, urp_data(4, 2.0, 6), 0.1, 0.0),
    "everything": (EVERYTHING, everything_data(), 0.07, 1.0),
}


@pytest.mark.parametrize("impute", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients_are_those_of_whole_trajectories(name: str, impute: bool) -> None:
    text, data, max_step, blend = CASES[name]
    problem, parameters, theta = problem_of(model_of(text), data, max_step, blend=blend)
    problem = imputed(problem) if impute else problem
    losses, gradients = [], []
    for solve in (by_hand, unroll):
        vector = torch.from_numpy(theta).requires_grad_()
        found = solve(problem, parameters, vector)
        residuals, departure = found if isinstance(found, tuple) else (found.residuals, found.departure)
        loss = (residuals**2).sum()
        losses.append((loss.item(), departure.detach().numpy()))
        gradients.append(torch.autograd.grad(loss, vector)[0].numpy())
    assert losses[1][0] == pytest.approx(losses[0][0], rel=1e-12)
    assert np.allclose(losses[1][1], losses[0][1], rtol=1e-12, atol=1e-12)
    assert np.abs(gradients[1] - gradients[0]).max() <= 1e-12 * np.abs(gradients[0]).max()


def test_intervals_between_fully_measured_rows_are_pieces() -> None:
    problem, _, _ = problem_of(model_of(URP), urp_data(4, 2.0, 6, together=True), 0.1)
    packed, pieces = problem.packed, problem.schedule.pieces
    assert len(pieces.owner) == packed.rows, "one a row"
    gaps = [np.diff(packed.row_step[packed.row_trajectory == i], prepend=0) for i in range(packed.trajectories)]
    assert sorted(pieces.length, reverse=True) == pieces.length.tolist() == sorted(np.concatenate(gaps))[::-1]
    assert pieces.depth == max(gap.max() for gap in gaps) < packed.depth
    assert [pieces.live(s) for s in (0, pieces.depth - 1, pieces.depth)] == [len(pieces.length), 1, 0]
    free = cut(packed, np.zeros_like(problem.forcing.weight))
    assert sorted(free.owner) == list(range(packed.trajectories)), "nothing forced: one a trajectory"
    assert sorted(free.length) == sorted(packed.steps)
    assert np.array_equal(free.owner[free.row_piece], packed.row_trajectory)
