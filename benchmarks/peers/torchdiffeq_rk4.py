"""torchdiffeq's fixed-step Runge-Kutta method with teacher forcing (its `rk4` is the 3/8 rule, of equal cost)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torchdiffeq import odeint

from benchmarks.peers.torch_eager import Naive, Step, gradient, tensor
from benchmarks.workload import Workload


def packed_loss(work: Workload, model: Naive, dtype: torch.dtype) -> Callable[[], Tensor]:
    """The loss by one `odeint` for each packed sub-step, with an individual step length for every trajectory."""
    h = tensor(work.h, dtype)[..., None]
    value, mask, weight = (tensor(a, dtype) for a in (work.value, work.mask, work.weight))
    unit = torch.tensor([0.0, 1.0], dtype=dtype)

    def run() -> Tensor:
        x, loss = model.start, torch.zeros((), dtype=dtype)
        for s in range(len(value)):
            if s > 0:
                x = odeint(lambda _, y, h=h[s - 1]: h * model(y), x, unit, method="rk4")[-1]
            loss = loss + (weight[s] * (x - value[s]) ** 2).sum()
            x = torch.where(mask[s] * work.blend > 0, value[s], x)
        return loss

    return run


def packed_step(work: Workload, dtype: torch.dtype) -> Step:
    """The step by `packed_loss`."""
    model = Naive(work, dtype)
    loss = packed_loss(work, model, dtype)
    return lambda: gradient(model, loss())


def interval(work: Workload, dtype: torch.dtype) -> Step:
    """One `odeint` for each interval between key times, with as many steps as the longest one needs."""
    model = Naive(work, dtype)
    length, value, mask = (tensor(a, dtype) for a in (work.interval[..., None], work.row_value, work.row_mask))
    weight = 0.5 * mask / tensor(work.scale, dtype) ** 2 / work.measured
    unit = torch.tensor([0.0, 1.0], dtype=dtype)

    def run() -> tuple[Tensor, tuple[Tensor, ...]]:
        x, loss = model.start, torch.zeros((), dtype=dtype)
        for k in range(len(length)):
            options = {"step_size": 1.0 / max(int(work.count[k].max()), 1)}
            x = odeint(lambda _, y, d=length[k]: d * model(y), x, unit, method="rk4", options=options)[-1]
            loss = loss + (weight[k] * (x - value[k]) ** 2).sum()
            x = torch.where(mask[k] * work.blend > 0, value[k], x)
        return gradient(model, loss)

    return run
