"""Solutions with delays. Only modules of models with delays have them, without everything above the line `# <body>`."""

from __future__ import annotations

import itertools
import math as _math
from typing import Any

import numpy as np

from gbspec.backends.module.template.arithmetic import _torch_arithmetic
from gbspec.backends.module.template.vectors import _signal, _tensor

_NAMES = (itertools, _math, np)

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


def _delayed_solution(model: Any, x: Any, grid: list[float], given: Any, inputs: Any, limit: Any) -> Any:
    """The states of `simulate` [..., n_times, n_states] for a model with delays, from x [..., n_states].

    Each row has its own steps, which move with its delays. Those of a function of time are common to all rows.
    """
    import torch

    batch, signal = x.shape[:-1], _signal(model, inputs, grid, x)
    count = _math.prod(batch)

    def flat(value: Any) -> Any:
        return value.expand(*batch, value.shape[-1]).reshape(count, value.shape[-1])

    def at(i: int, node: Any) -> Any:
        return flat(signal(i, float(node[0]) if callable(inputs) else node.reshape(*batch, 1)))

    k = tuple(v.expand(batch).reshape(count) if v.ndim else v for v in given[1])
    x, own, equations = flat(x), (flat(given[0]), k, given[2]), model.equations
    rhs = equations.field(_torch_arithmetic(), *own)
    past = equations.past(own, x.new_full((count,), grid[0]), x, flat(signal(0, grid[0])))
    shortest = float(past.lags.detach().min())
    if not shortest > 0:
        raise ValueError(f"a delay is {shortest:.6g}, and it must be positive")
    origins = [grid[0]]
    if model.inputs and inputs is not None and not callable(inputs):
        origins += _changes(model, grid, model.defaulted(inputs, "inputs", x))
    found = [x]
    steps = _batch_steps(grid, (origins, equations.echoes), past.lags, limit, callable(inputs))
    for i, (begins, sizes, fresh) in enumerate(steps):
        for t, h, new in zip(begins, sizes, fresh, strict=True):
            nodes = equations.grid(_torch_arithmetic(), t, h)
            u = tuple(at(i, node) for node in nodes[0])
            x, _ = past.across(t, h, nodes, x, u, rhs, not new)
        found.append(x)
    return torch.stack(found, -2).reshape(*batch, len(grid), -1)


def _changes(model: Any, grid: list[float], table: Any) -> list[float]:
    """The times at which delayed inputs, given at the times of `grid` as `table` [..., n_times, n_inputs], jump or
    bend in any row."""
    found: set[float] = set()
    for place in model.equations.delayed_inputs:
        values = np.moveaxis(table[..., place].detach().cpu().double().numpy(), -1, 0).reshape(len(grid), -1)
        steps = np.diff(values, axis=0)
        if model.interpolation[place] == "linear":
            slopes = steps / np.diff(grid)[:, None]
            different = np.abs(np.diff(slopes, axis=0)) > 1e-9 * np.abs(slopes).max(initial=0.0)
            found.update(np.array(grid[1:-1])[different.any(1)].tolist())
        else:
            found.update(np.array(grid[1:])[(steps != 0).any(1)].tolist())
    return sorted(found)


def _batch_steps(grid: list[float], origins: tuple[list[float], int], lags: Any, limit: Any, common: bool) -> Any:
    """For each interval of `grid` the begins and sizes [n_steps, B] of the steps, which move with the delays `lags`
    [n_lags, B], and for each step whether something may have happened before it in any row.

    `common`: one sequence of steps for all rows, which then does not move if their delays differ.
    """
    values = lags.detach().cpu().double().numpy().T
    kinds, kind = np.unique(values, axis=0, return_inverse=True)
    if common and len(kinds) > 1:
        few, kind, still = np.unique(values)[:4], np.zeros(len(values), dtype=np.int64), np.zeros(len(lags))
        shared = _row_steps(grid, origins, few, float(values.min()), limit)
        tables = [[((part @ np.array([1.0, *few]))[..., None] * np.append(1.0, still), new) for part, new in shared]]
    else:
        tables = [_row_steps(grid, origins, row, float(row.min()), limit) for row in kinds]
    for end, each in zip(grid[1:], zip(*tables, strict=True), strict=True):
        most = max(len(fresh) for _, fresh in each)
        padded = np.zeros((len(each), most, 2, 1 + len(lags)))  # rows with fewer steps end with some of no length
        padded[:, :, 0, 0] = end
        began = np.ones((len(each), most), dtype=bool)
        for row, (part, fresh) in enumerate(each):
            padded[row, : len(part)], began[row, : len(part)] = part, fresh
        parts = lags.new_tensor(padded[kind.reshape(-1)].swapaxes(0, 1))
        times = parts[..., 0] + (parts[..., 1:] * lags.T.unsqueeze(1)).sum(-1)
        yield times[..., 0], times[..., 1], began.any(0).tolist()


def _row_steps(
    grid: list[float], origins: tuple[list[float], int], lags: Any, shortest: float, limit: Any
) -> list[Any]:
    """The steps of one row: for each interval of `grid` begins and sizes [n_steps, 2, 1 + n_lags], as a number and
    multiples of the delays `lags` [n_lags], and for each whether something may have happened before it.

    Steps begin one delay after the times in `origins`, and up to as many as it says: there rates or their derivatives
    jump.
    """
    n, span, largest = len(lags), grid[-1] - grid[0], shortest if limit is None else min(limit, shortest)
    sums: list[tuple[int, ...]] = []
    for size in range(1, 1 + origins[1]):
        more = list(itertools.combinations_with_replacement(range(n), size))
        if sums and len(sums) + len(more) > 20:
            break
        sums += more
    ahead = [[combination.count(k) for k in range(n)] for combination in sums]
    marks, weights = np.array([[time, *counts] for time in origins[0] for counts in ahead]), np.array([1.0, *lags])
    marks = marks[np.argsort(marks @ weights, kind="stable")]
    times, found = marks @ weights, []
    for start, end in itertools.pairwise(grid):
        first, last = np.searchsorted(times, [start + 1e-9 * span, end - 1e-9 * span])
        apart = np.diff(times[first:last], prepend=start) > 1e-9 * span
        ends = np.zeros((2 + int(apart.sum()), 1 + n))
        ends[0, 0], ends[1:-1], ends[-1, 0] = start, marks[first:last][apart], end
        widths = np.diff(ends, axis=0)
        parts = np.ceil(widths @ weights / largest - 1e-9).clip(min=1).astype(np.int64)
        place = np.concatenate([np.arange(count) for count in parts])
        sizes = np.repeat(widths / parts[:, None], parts, axis=0)
        begins = np.repeat(ends[:-1], parts, axis=0) + place[:, None] * sizes
        found.append((np.stack([begins, sizes], 1), (place == 0).tolist()))
    return found
