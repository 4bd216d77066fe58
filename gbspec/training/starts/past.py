"""Delayed values at points of the splines: the curves a time ago, with their derivatives by the delays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, Networks
from gbspec.data import Trajectories, evaluate
from gbspec.ir import Model
from gbspec.training.engines import torch_arithmetic
from gbspec.training.problem import Integers
from gbspec.training.starts.splines import Curves


@dataclass(frozen=True)
class Past:
    """The curves of trajectories before any time; states without curves have the values `guess` [N, n_states]."""

    model: Model
    trajectories: Trajectories
    curves: Curves
    guess: Array

    def late(
        self, module: GeneratedModule, t: Tensor, owner: Integers, c: Tensor, k: Sequence[Tensor], networks: Networks
    ) -> Tensor:
        """The delayed values [M, n_delays] at times [M] of the trajectories `owner` [M]."""
        m, columns = torch_arithmetic(module), []
        groups = [lag for _, lag in module.equations.delays]
        lags = module.equations.lags(m, c.unbind(-1), k)
        found = []
        for lag in lags:
            s = t - lag
            x, u = self._at(module, s, owner, c, k)
            found.append(module.equations.delayed(m, s, x, c, u, k, networks))
        for column, lag in enumerate(groups):
            columns.append(found[lag][..., column].expand(t.shape))
        return torch.stack(columns, -1)

    def _at(
        self, module: GeneratedModule, s: Tensor, owner: Integers, c: Tensor, k: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """States [M, n_states] and inputs [M, n_inputs] at times [M]."""
        now = s.detach().numpy()
        items = self.trajectories.items
        begin = np.array([item.start for item in items])[owner]
        value, slope, start = (np.zeros((len(now), len(self.model.states))) for _ in range(3))
        inputs = np.zeros((len(now), len(self.model.inputs)))
        for i in np.unique(owner):
            mine, item = owner == i, items[i]
            times, first = np.maximum(now[mine], item.start), np.array([item.start])
            for state, curve in enumerate(self.curves.items[i]):
                if curve is None:
                    value[mine, state] = start[mine, state] = self.guess[i, state]
                    continue
                inside = (times >= curve.low) & (times <= curve.high)
                value[mine, state], start[mine, state] = curve.extended(times), curve.extended(first)[0]
                slope[mine, state] = np.where(inside, curve.slope(np.clip(times, curve.low, curve.high)), 0.0)
            for j, (spec, signal) in enumerate(zip(self.model.inputs, item.inputs, strict=True)):
                inputs[mine, j] = evaluate(signal, spec.interpolation, times)
        after = torch.from_numpy(now >= begin)[:, None]
        moved = (s - s.detach())[:, None]
        x = torch.from_numpy(value) + torch.from_numpy(slope) * moved
        early = torch.where(after[:, 0], torch.from_numpy(begin), s)
        before = module.equations.history(torch_arithmetic(module), early, torch.from_numpy(start), c.unbind(-1), k)
        return torch.where(after, x, before.expand(x.shape)), torch.from_numpy(inputs)
