"""Hand-written torch: straightforward code, and an optimised version of the same computation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from benchmarks.workload import Workload

Step = Callable[[], tuple[Tensor, tuple[Tensor, ...]]]


def tensor(value: Any, dtype: torch.dtype) -> Tensor:
    return torch.as_tensor(value).to(dtype)


class Naive(nn.Module):
    """The right-hand side, written straightforwardly."""

    def __init__(self, work: Workload, dtype: torch.dtype) -> None:
        super().__init__()
        self.weights = nn.ParameterList([tensor(a, dtype) for layer in work.layers for a in layer])
        self.constants = nn.Parameter(tensor(work.constants, dtype).clone())
        self.start = nn.Parameter(tensor(work.start, dtype).clone())
        self.condition = tensor(work.condition, dtype)
        self.scales = [
            tensor(a, dtype) for a in (work.input_center, work.input_scale, work.output_center, work.output_scale)
        ]

    def forward(self, x: Tensor) -> Tensor:
        """dx/dt [N, n] at states x [N, n]."""
        center, scale, output_center, output_scale = self.scales
        a = (torch.cat([x[:, :2], self.condition], dim=1) - center) / scale
        weights = list(self.weights)
        for i in range(0, len(weights) - 2, 2):
            a = silu(nn.functional.linear(a, weights[i], weights[i + 1]))
        phi = (output_center + output_scale * nn.functional.linear(a, weights[-2], weights[-1]))[:, 0]
        B, beta = self.constants
        dx1 = -x[:, 0] + phi
        dx2 = -x[:, 1] + B * phi - beta * x[:, 1]
        chain = x[:, 1:-1] - x[:, 2:]
        return torch.cat([torch.stack([dx1, dx2], dim=1), chain], dim=1)


def rk4(f: Callable[[Tensor], Tensor], x: Tensor, h: Tensor) -> Tensor:
    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    k4 = f(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def gradient(model: Naive, loss: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    return loss.detach(), torch.autograd.grad(loss, [*model.weights, model.constants, model.start])


def naive(work: Workload, dtype: torch.dtype) -> Step:
    """All trajectories' sub-steps packed without gaps, otherwise straightforward code."""
    model = Naive(work, dtype)
    h = tensor(work.h, dtype)[..., None]
    value, mask, weight = (tensor(a, dtype) for a in (work.value, work.mask, work.weight))

    def run() -> tuple[Tensor, tuple[Tensor, ...]]:
        x, loss = model.start, torch.zeros((), dtype=dtype)
        for s in range(len(value)):
            if s > 0:
                x = rk4(model, x, h[s - 1])
            loss = loss + (weight[s] * (x - value[s]) ** 2).sum()
            x = torch.where(mask[s] * work.blend > 0, value[s], x)
        return gradient(model, loss)

    return run


def aligned(work: Workload, dtype: torch.dtype) -> Step:
    """A straightforward loop over key times, in which all trajectories wait for the one with the longest interval."""
    model = Naive(work, dtype)
    interval, value, mask = (tensor(a, dtype) for a in (work.interval, work.row_value, work.row_mask))
    weight = 0.5 * mask / tensor(work.scale, dtype) ** 2 / work.measured
    counts = torch.from_numpy(work.count)

    def run() -> tuple[Tensor, tuple[Tensor, ...]]:
        x, loss = model.start, torch.zeros((), dtype=dtype)
        for k in range(len(interval)):
            for j in range(int(counts[k].max())):
                h = torch.where(j < counts[k], interval[k] / counts[k].clamp_min(1), 0.0)[:, None]
                x = rk4(model, x, h)
            loss = loss + (weight[k] * (x - value[k]) ** 2).sum()
            x = torch.where(mask[k] * work.blend > 0, value[k], x)
        return gradient(model, loss)

    return run


def well_written(work: Workload, dtype: torch.dtype) -> Step:
    """Optimised: condition folded into the first bias, output layer fused with the balances, step sizes precomputed."""
    leaves = [tensor(a, dtype).clone().requires_grad_() for layer in work.layers for a in layer]
    constants = tensor(work.constants, dtype).clone().requires_grad_()
    start = tensor(work.start, dtype).clone().requires_grad_()
    center, scale, output_center, output_scale, condition = (
        tensor(a, dtype)
        for a in (work.input_center, work.input_scale, work.output_center, work.output_scale, work.condition)
    )
    n, depth = work.size.states, len(work.h)
    h = tensor(work.h, dtype)[..., None]
    full, half, sixth = h.unbind(0), (h / 2).unbind(0), (h / 6).unbind(0)
    value, mask = (tensor(a, dtype).unbind(0) for a in (work.value, work.mask))
    weight = tensor(work.weight, dtype)
    base = torch.diag(-torch.ones(n, dtype=dtype))
    for i in range(2, n):
        base[i - 1, i] = 1.0
    second = torch.zeros((n, n), dtype=dtype)
    second[1, 1] = 1.0

    def right_hand_side() -> Callable[[Tensor], Tensor]:
        w1, b1, *middle, w3, b3 = leaves
        B, beta = constants
        first = w1 / scale
        bias = torch.addmm(b1 - first @ center, condition, first[:, 2:].T)
        into = first[:, :2].T
        hidden = [(w.T, b) for w, b in zip(middle[::2], middle[1::2], strict=True)]
        direction = torch.cat([torch.ones(1, dtype=dtype), B[None], torch.zeros(n - 2, dtype=dtype)])
        out = (output_scale * w3).T * direction
        shift = (output_center + output_scale * b3) * direction
        linear = base - beta * second

        def f(x: Tensor) -> Tensor:
            a = silu(torch.addmm(bias, x if n == 2 else x[:, :2], into))
            for w, b in hidden:
                a = silu(torch.addmm(b, a, w))
            return torch.addmm(torch.addmm(shift, x, linear), a, out)

        return f

    def run() -> tuple[Tensor, tuple[Tensor, ...]]:
        f, x, deviations = right_hand_side(), start, []
        for s in range(depth + 1):
            if s > 0:
                k1 = f(x)
                k2 = f(torch.addcmul(x, half[s - 1], k1))
                k3 = f(torch.addcmul(x, half[s - 1], k2))
                k4 = f(torch.addcmul(x, full[s - 1], k3))
                x = torch.addcmul(x, sixth[s - 1], torch.add(k1 + k4, k2 + k3, alpha=2))
            deviation = mask[s] * (x - value[s])
            deviations.append(deviation)
            if work.blend:
                x = x - deviation
        loss = (weight * torch.stack(deviations) ** 2).sum()
        return loss.detach(), torch.autograd.grad(loss, [*leaves, constants, start])

    return run
