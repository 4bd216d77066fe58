"""The reactor fitted by hand: torch, torchdiffeq and Adam with a one-cycle schedule, teacher forcing, full batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from benchmarks.peers.torch_eager import Naive
from benchmarks.peers.torchdiffeq_rk4 import packed_loss
from benchmarks.workload import Workload

RATE = 1e-2
"""Peak learning rate of weights and initial states."""
CONSTANTS = 5.0
"""Factor of the learning rate for constants: they are few, and their starting values are far off."""


class Positive(nn.Module):
    """A positive number as the exponential of a trained parameter."""

    def forward(self, x: Tensor) -> Tensor:
        """The number."""
        return x.exp()

    def right_inverse(self, x: Tensor) -> Tensor:
        """The trained parameters."""
        return x.log()


def fit(work: Workload, steps: Callable[[Callable[[], None]], int], record: Callable[[Any], None]) -> None:
    """Trains; `steps` returns the affordable number of steps after trying one; `record` gets weights and constants."""
    model = Naive(work, torch.float32)
    parametrize.register_parametrization(model, "constants", Positive())
    loss = packed_loss(work, model, torch.float32)
    constants = model.parametrizations.constants.original
    optimiser = torch.optim.Adam([{"params": [*model.weights, model.start]}, {"params": [constants]}], lr=RATE)

    def step() -> None:
        optimiser.zero_grad()
        with parametrize.cached():
            loss().backward()
        optimiser.step()

    total = steps(step)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, [RATE, CONSTANTS * RATE], total_steps=total + 1)
    for _ in range(total):
        step()
        schedule.step()
        with torch.no_grad():
            record(([w.numpy().copy() for w in model.weights], model.constants.numpy().copy()))
