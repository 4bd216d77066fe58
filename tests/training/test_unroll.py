"""The unrolled solver equals one trajectory after the other, stepped by hand; segments are as long as need be."""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gbspec.training.engines.arithmetic import observe_rows, torch_arithmetic
from gbspec.training.engines.torch import memory
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.engines.torch.segments import cut
from gbspec.training.engines.torch.unroll import graph_residuals
from gbspec.training.problem.forcing import Forcing
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data
from tests.training.reference import schedule_of, unroll


def by_hand(problem: Problem, parameters: Parameters, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals [R, C] and states after resets [R, n_states]: every trajectory by itself, whole, step by step."""
    packed, module, ops = problem.packed, problem.module, torch_arithmetic(problem.module)
    networks = module.torch_networks(parameters.weights(theta))
    constants, starts = parameters.constants(theta), parameters.starts(theta)
    condition = torch.from_numpy(packed.condition)
    before: list[Tensor] = [torch.zeros(0)] * packed.rows
    after = list(before)
    for i in range(packed.trajectories):
        c, k = condition[i : i + 1], tuple(constants[i : i + 1].unbind(1))
        x = module.equations.initial(ops, starts[i : i + 1], c, k)
        done = 0
        for row in np.flatnonzero(packed.row_trajectory == i):
            for s in range(done, packed.row_step[row]):
                t, h = (torch.from_numpy(table[s, i : i + 1]) for table in (packed.t, packed.h))
                nodes = torch.from_numpy(packed.inputs[s, i : i + 1]).unbind(1)
                field = module.equations.field(ops, c, k, networks)
                x = module.equations.step(ops, field, module.equations.grid(ops, t, h), x, nodes)
            done = int(packed.row_step[row])
            before[row] = x[0]
            value, weight = (torch.from_numpy(table[row]) for table in (problem.forcing.value, problem.forcing.weight))
            x = x - weight * (x - value)
            after[row] = x[0]
    owner = torch.from_numpy(packed.row_trajectory)
    mean = observe_rows(problem, torch.stack(before), constants[owner], networks)
    return graph_residuals(problem, mean), torch.stack(after)


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
        residuals, after = found if isinstance(found, tuple) else (found.residuals, found.after)
        loss = (residuals**2).sum()
        losses.append((loss.item(), after.detach().numpy()))
        gradients.append(torch.autograd.grad(loss, vector)[0].numpy())
    assert losses[1][0] == pytest.approx(losses[0][0], rel=1e-12)
    assert np.allclose(losses[1][1], losses[0][1], rtol=1e-12, atol=1e-12)
    assert np.abs(gradients[1] - gradients[0]).max() <= 1e-12 * np.abs(gradients[0]).max()


def test_intervals_between_fully_measured_rows_are_segments() -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(4, 2.0, 6, together=True), 0.1)
    packed, segments = problem.packed, schedule_of(problem, parameters, theta).segments
    assert len(segments.owner) == packed.rows, "one a row"
    gaps = [np.diff(packed.row_step[packed.row_trajectory == i], prepend=0) for i in range(packed.trajectories)]
    assert sorted(segments.length, reverse=True) == segments.length.tolist() == sorted(np.concatenate(gaps))[::-1]
    assert segments.depth == max(gap.max() for gap in gaps) < packed.depth
    assert [segments.live(s) for s in (0, segments.depth - 1, segments.depth)] == [len(segments.length), 1, 0]
    free = cut(packed, np.zeros_like(problem.forcing.weight))
    assert sorted(free.owner) == list(range(packed.trajectories)), "nothing forced: one a trajectory"
    assert sorted(free.length) == sorted(packed.steps)
    assert np.array_equal(free.owner[free.row_segment], packed.row_trajectory)


class Peak(TorchDispatchMode):
    """The most bytes of tensors, made within, that were alive at once."""

    def __init__(self) -> None:
        super().__init__()
        self.live = self.most = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, Tensor) and not hasattr(storage := tensor.untyped_storage(), "counted"):
                storage.counted = True
                self.live += storage.nbytes()
                self.most = max(self.most, self.live)
                weakref.finalize(storage, self.free, storage.nbytes())
        return out

    def free(self, size: int) -> None:
        self.live -= size


def gradient(problem: Problem, parameters: Parameters, theta: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    vector = torch.from_numpy(theta).requires_grad_()
    loss = (unroll(problem, parameters, vector).residuals ** 2).sum()
    return torch.autograd.grad(loss, vector)[0].numpy()


def peak_of_gradient(problem: Problem, parameters: Parameters, theta: np.ndarray[Any, Any]) -> int:
    engine = TorchEngine(problem, parameters)
    path = engine.plan(theta)
    engine.schedule(path)  # made beforehand, as it is kept whatever the graph does
    with Peak() as peak:
        engine.half_squares(theta, path)
    return peak.most


@pytest.mark.parametrize("text", [URP, EVERYTHING])
def test_a_graph_with_checkpoints_has_the_same_gradient(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = urp_data(4, 2.0, 6) if text is URP else everything_data()
    problem, parameters, theta = problem_of(model_of(text), data, 0.1)
    whole = gradient(problem, parameters, theta)
    monkeypatch.setattr(memory, "FEW", 0)
    monkeypatch.setattr(memory, "GRAPH_BYTES", 100_000)
    live = [len(step.t) for step in schedule_of(problem, parameters, theta).steps]
    assert len(memory.checkpoint_intervals(live, lambda: 10_000)) > 3
    found = gradient(problem, parameters, theta)
    assert np.array_equal(found, whole)


def test_the_peak_does_not_grow_with_the_length(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(2, 2.0, 6), 0.1, blend=0.0)
    finer, *_ = problem_of(model_of(URP), urp_data(2, 2.0, 6), 0.03, blend=0.0)
    assert finer.packed.depth > 2.5 * problem.packed.depth
    coarse_peak, fine_peak = (peak_of_gradient(each, parameters, theta) for each in (problem, finer))
    assert fine_peak > 2 * coarse_peak, "one graph grows"
    limit = coarse_peak // 4
    monkeypatch.setattr(memory, "FEW", 0)
    monkeypatch.setattr(memory, "GRAPH_BYTES", limit)
    for each in (problem, finer):
        assert peak_of_gradient(each, parameters, theta) < 2.5 * limit


def test_checkpoint_intervals_are_as_long_as_the_limit_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "FEW", 10)
    monkeypatch.setattr(memory, "GRAPH_BYTES", 100)
    assert memory.checkpoint_intervals([5, 5], lambda: 1 // 0) == [(0, 2)], "few sub-steps are not measured"
    assert memory.checkpoint_intervals([10, 9, 1], lambda: 5) == [(0, 3)]
    assert memory.checkpoint_intervals([10, 10, 9, 6, 5, 1], lambda: 5) == [(0, 2), (2, 5), (5, 6)]
    assert memory.checkpoint_intervals([50, 3, 2], lambda: 10) == [(0, 1), (1, 3)], "a sub-step is never cut"


def test_what_a_row_keeps_is_measured() -> None:
    weight = torch.randn(30, 30, requires_grad=True)
    assert memory.kept_bytes(lambda n: torch.tanh(torch.zeros(n, 30) @ weight)) == 2 * 30 * 4
