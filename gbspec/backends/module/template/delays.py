"""Solutions with delays. Only modules of models with delays have them, without everything above the line `# <body>`."""

from __future__ import annotations

import itertools
import math as _math
from typing import Any

from gbspec.backends.module.template.arithmetic import _torch_arithmetic
from gbspec.backends.module.template.vectors import _tensor

_NAMES = (itertools, _math)

# <body>
# ---------------------------------------------------------------------- delays
# `equations.delays` has (name, index of its lag) of each delay; `lags` their times, `delayed` what is delayed,
# `history` the state before the start. The equations take delayed values behind the inputs. A step of the solver is
# kept as the cubic polynomial of the states and rates at its ends, of which a later step takes delayed values: no step
# is longer than the shortest delay.


class _Past:
    """The solution so far of a batch of B rows: a piece for each step, of as many first rows as the step had.

    `given` are conditions, constants and networks; the rows begin at `begin` [B] with the states `start` [B, n_states]
    and the inputs `inputs` [B, n_inputs], which hold before it.
    """

    def __init__(self, equations: Any, given: Any, begin: Any, start: Any, inputs: Any) -> None:
        import torch

        self.equations, self.begin, self.start, self.first = equations, begin, start, inputs
        self.condition, self.constants, self.networks = given
        self.condition = self.condition if isinstance(self.condition, tuple) else self.condition.unbind(-1)
        lags = equations.lags(_torch_arithmetic(), self.condition, self.constants)
        self.lags = torch.stack([_tensor(lag, start).expand(start.shape[:1]) for lag in lags])
        self.shortest = self.lags.detach().amin(0).cpu().numpy()
        self.group = [lag for _, lag in equations.delays]
        self.pieces: list[Any] = []
        self.begins = start.new_full((64, len(start)), _math.inf)
        self.rate: Any = None

    def rows(self, values: Any, count: int) -> tuple[Any, ...]:
        """The first rows of conditions or constants, of which some are one number for all."""
        return tuple(v[:count] if hasattr(v, "ndim") and v.ndim else v for v in values)

    def values(self, times: Any, middle: Any) -> Any:
        """The delayed quantities [K, B, n_delays] at times [K, B]; where these meet an end of an earlier step, the side
        towards `middle` ([K, B] or [B]) counts."""
        import torch

        count = times.shape[1]
        lags = self.lags[:, :count]
        s = (times.unsqueeze(1) - lags).flatten(0, 1)  # [K * lags, B]
        toward = (middle.expand(times.shape).unsqueeze(1) - lags).flatten(0, 1)
        with torch.no_grad():
            near = s + (1e-7 if s.dtype == torch.float64 else 1e-3) * (toward - s)
            index = (self.begins[: len(self.pieces), :count].unsqueeze(1) <= near).sum(0) - 1
            index = torch.where(near < self.begin[:count], -1, index.clamp(min=0 if self.pieces else -1))
        s = self._inside(s, toward, lags)
        x, u = self._looked_up(s, index)
        m, c, k = _torch_arithmetic(), self.rows(self.condition, count), self.rows(self.constants, count)
        found = self.equations.delayed(m, s, x, c, u, k, self.networks)
        found = found.expand(*s.shape, len(self.group)).unflatten(0, (len(times), len(lags)))
        return torch.stack([found[:, lag, :, i] for i, lag in enumerate(self.group)], -1)

    def _inside(self, s: Any, toward: Any, lags: Any) -> Any:
        """Times [K * lags, B] moved a rounding error towards others, where formulas jump at times of their own: not to
        be on the other side of a jump at the end of a step."""
        if not hasattr(self.equations, "schedule"):
            return s
        away = (toward - s).detach()
        size = 1e-13 * (s.detach().abs() + lags.detach().repeat(len(s) // len(lags), 1))
        return s + away.sign() * size.minimum(1e-3 * away.abs())

    def _looked_up(self, s: Any, index: Any) -> tuple[Any, Any]:
        """States and inputs at times [K, B] in the pieces `index` (-1: before the start)."""
        import torch

        count, before = s.shape[1], index < 0
        m, found = _torch_arithmetic(), None
        if not bool(before.all()):
            found = self._interpolated(torch.where(before, self.begin[:count], s), index.clamp(min=0))
        if found is not None and not bool(before.any()):
            return found
        condition, constants = self.rows(self.condition, count), self.rows(self.constants, count)
        early = torch.where(before, s, self.begin[:count])
        start = self.start[:count].expand(*s.shape, -1)
        x = self.equations.history(m, early, start, condition, constants).expand(start.shape)
        u = self.first[:count].expand(*s.shape, -1)
        if found is None:
            return x, u
        outside = before.unsqueeze(-1)
        return torch.where(outside, x, found[0]), torch.where(outside, u, found[1])

    def _interpolated(self, s: Any, index: Any) -> tuple[Any, Any]:
        """States and inputs at times [K, B] in the pieces `index` [K, B]."""
        import torch

        count, n = s.shape[1], self.start.shape[1]
        low, high = int(index.min()), int(index.max())
        block = torch.stack([piece[:count] for piece in self.pieces[low : high + 1]])
        if high == low:
            piece = block.expand(len(s), -1, -1)
        else:
            piece = block.gather(0, (index - low).unsqueeze(-1).expand(-1, -1, block.shape[-1]))
        (t, h), (x0, f0, x1, f1) = piece[..., :2].unbind(-1), piece[..., 2 : 2 + 4 * n].chunk(4, -1)
        share = ((s - t) / torch.where(h == 0, torch.ones_like(h), h)).unsqueeze(-1)
        u0, u1 = piece[..., 2 + 4 * n :].chunk(2, -1) if self.first.shape[1] else (self.first[:count],) * 2
        h, whole = h.unsqueeze(-1), x1 - x0
        bend = (1 - share) * (h * f0 - whole) + share * (whole - h * f1)
        x = x0 + share * whole + share * (1 - share) * bend
        return x, (u0 + share * (u1 - u0)).expand(*s.shape, -1)

    def across(
        self, t: Any, h: Any, grid: Any, x: Any, u: Any, rhs: Any, smooth: bool, late: Any = None
    ) -> tuple[Any, Any]:
        """The state after a step from t [B] of size h [B] with inputs `u` at its nodes, and the delayed values there.

        `smooth`: nothing happened between the step before and this one; `late`: the delayed values at the nodes
        [nodes, B, n_delays], if they are known.
        """
        import torch

        m, times = _torch_arithmetic(), [_tensor(node, x).expand(len(x)) for node in grid[0]]
        late = self.values(torch.stack(times), t + h / 2) if late is None else late
        nodes = tuple(torch.cat([a, b], -1) for a, b in zip(u, late.unbind(0), strict=True))
        rate = self.rate[: len(x)] if smooth and self.rate is not None else rhs(times[0], x, nodes[0])

        def field(time: Any, state: Any, inputs: Any) -> Any:
            return rate if state is x else rhs(time, state, inputs)

        end = self.equations.step(m, field, grid, x, nodes)
        self.rate = rhs(times[-1], end, nodes[-1])
        columns = [t.unsqueeze(-1), h.unsqueeze(-1), x, rate.expand(x.shape), end, self.rate.expand(x.shape)]
        number = len(self.pieces)
        if number == len(self.begins):
            self.begins = torch.cat([self.begins, torch.full_like(self.begins, _math.inf)])
        self.begins[number, : len(x)] = t.detach()
        self.pieces.append(torch.cat([*columns, u[0], u[-1]], -1))
        return end, late[-1]


def _width(model: Any) -> int:
    """How many inputs and delayed values the equations take."""
    return len(model.inputs) + len(getattr(model.equations, "delays", ()))


def _delayed_solution(
    model: Any, x: Any, grid: list[float], condition: Any, constants: Any, networks: Any, signal: Any, limit: Any
) -> Any:
    """The states of `simulate` [..., n_times, n_states] for a model with delays, from x [..., n_states]."""
    import torch

    batch = x.shape[:-1]
    count = _math.prod(batch)

    def flat(value: Any) -> Any:
        return value.expand(*batch, value.shape[-1]).reshape(count, value.shape[-1])

    k = tuple(v.expand(batch).reshape(count) if v.ndim else v for v in constants)
    x, given, equations = flat(x), (flat(condition), k, networks), model.equations
    rhs = equations.field(_torch_arithmetic(), *given)
    past = equations.past(given, x.new_full((count,), grid[0]), x, flat(signal(0, grid[0])))
    shortest = float(past.lags.detach().min())
    if not shortest > 0:
        raise ValueError(f"a delay is {shortest:.6g}, and it must be positive")
    largest = shortest if limit is None else min(limit, shortest)
    found = [x]
    for i, start, end in _stretches(grid, past.lags):
        parts = max(1, _math.ceil((end - start) / largest - 1e-9))
        h = x.new_full((count,), (end - start) / parts)
        for j in range(parts):
            t = x.new_full((count,), start + j * (end - start) / parts)
            nodes = equations.grid(_torch_arithmetic(), t, h)
            u = tuple(flat(signal(i, float(node[0]))) for node in nodes[0])
            x, _ = past.across(t, h, nodes, x, u, rhs, bool(j))
        if end == grid[i + 1]:
            found.append(x)
    return torch.stack(found, -2).reshape(*batch, len(grid), -1)


def _stretches(grid: list[float], lags: Any) -> list[tuple[int, float, float]]:
    """The intervals between two times, cut where the start shows again after delays: there rates or their derivatives
    jump. Each has the index of its interval."""
    times, span = [grid[0]], grid[-1] - grid[0]
    values = sorted({float(lag) for lag in lags.detach().flatten()})[:4]
    for _ in range(4):
        times += [time + lag for time in times for lag in values if time + lag < grid[-1]]
        times = sorted(set(times))[:200]
    found = []
    for i, (start, end) in enumerate(itertools.pairwise(grid)):
        inside = [time for time in times if start + 1e-9 * span < time < end - 1e-9 * span]
        found += [(i, a, b) for a, b in itertools.pairwise([start, *inside, end])]
    return found
