"""A training problem: the generated module, packed data, scales and forcing, and the residuals that they define.

The residual of a measured value is `(prediction - value) / scale` (of logarithms under log-normal noise), times the
square root of the number of measurements that the value averages. `scale` is

- for a channel without a stated noise: the standard deviation of its data over all trajectories;
- for a channel with `noise normal(sd)`, `noise lognormal(cv)` or a column of standard deviations: that deviation,
  divided by the channels' common noise level (the mean of stated noise / standard deviation of the data), so that all
  residuals are in units of the data's deviation and the stated noises set the channels' relative weights.

In a model whose functions are all known, channels that have the same unit and no stated noise share one scale: the fit
is then the ordinary least squares of textbooks.

The loss is the mean over all measured values of rho(residual), with rho(r) = r^2 / 2, or Huber's function where a stage
says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gbspec.data.trajectories import Array, Trajectories
from gbspec.ir.model import Model
from gbspec.training.problem.packing import Packed

if TYPE_CHECKING:
    from gbspec.training.engines.native.kernel import Kernel
    from gbspec.training.engines.native.tables import Tables
    from gbspec.training.engines.torch.segments import Schedule

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Forcing:
    """Where states are replaced at key rows, and by how much.

    `value` [R, n_states] and `weight` [R, n_states] in [0, 1]: after the row's residual is taken,
    `x <- x - weight * (x - value)`. Teacher forcing has weight 1 at measured states, a blend less, autoregressive 0;
    imputed teacher forcing has weight 1 at every state, with values from splines.
    """

    value: Array
    weight: Array


@dataclass(frozen=True)
class Scaling:
    """How residuals are formed: `log` [C] (of logarithms), `row_scale` [R, C], `channel` [C] (the channel's scale).

    `noise` is the standard deviation of the noise in units of the residuals; None where a channel does not state its
    own.
    """

    log: Mask
    row_scale: Array
    channel: Array
    noise: float | None = None


@dataclass(frozen=True)
class Problem:
    """Everything a stage needs besides the trainable vector. `module` is an instance of the generated class.

    With a `kernel`, losses and gradients come from it; without one from the torch graph, which works on `device`.
    """

    model: Model
    module: Any
    packed: Packed
    forcing: Forcing
    scaling: Scaling
    kernel: Kernel | None = None
    device: str = "cpu"

    @property
    def ops(self) -> Any:
        """The arithmetic that the module's expressions are evaluated in (torch)."""
        return torch_arithmetic(self.module)

    def tables(self, time: Array) -> Tables:
        """The data as the kernel reads them, with doses that arrive at `time` [E]; those last asked for are kept."""
        from gbspec.training.engines.native.tables import Tables

        key = time.tobytes()
        if key not in self._tables:
            self._tables.clear()
            self._tables[key] = Tables(self, time)
        return self._tables[key]

    @cached_property
    def _tables(self) -> dict[bytes, Tables]:
        return {}

    @cached_property
    def schedule(self) -> Schedule:
        """The sub-steps as the torch graph takes them."""
        from gbspec.training.engines.torch.segments import Schedule

        return Schedule(self)

    @cached_property
    def schedule_in_float32(self) -> Schedule:
        """The same in single precision."""
        import torch

        from gbspec.training.engines.torch.segments import Schedule

        return Schedule(self, torch.float32)

    def forced(self, blend: float) -> Problem:
        """The same problem with teacher forcing of strength `blend`: 1 teacher forcing, 0 autoregressive."""
        return replace(self, forcing=teacher_forcing(self.model, self.packed, blend))

    def take(self, indices: Any) -> Problem:
        """The same problem with some of its trajectories; with all of them in their order it is the problem itself."""
        index = np.asarray(indices, dtype=np.int64)
        if np.array_equal(index, np.arange(self.packed.trajectories)):
            return self  # keeps what was prepared for it
        packed = self.packed.take(index)
        rows = matching_rows(self.packed, packed, index)
        return replace(
            self,
            packed=packed,
            forcing=Forcing(self.forcing.value[rows], self.forcing.weight[rows]),
            scaling=replace(self.scaling, row_scale=self.scaling.row_scale[rows]),
        )


def matching_rows(whole: Packed, part: Packed, index: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each row of `part = whole.take(index)`, the row of `whole` that it is."""
    return np.asarray(whole.row_table[index[part.row_trajectory], part.row_index], dtype=np.int64)


def torch_arithmetic(module: Any) -> Any:
    """The generated module's torch arithmetic."""
    return module.arithmetic("torch")


def measured_states(model: Model, packed: Packed) -> tuple[Array, Mask]:
    """Measured values of states [R, n_states] (NaN: not measured) and where there is one.

    Where two channels measure the same state, the later one in the model's order counts.
    """
    values = np.full((packed.rows, len(model.states)), np.nan)
    for index, channel in enumerate(model.channels):
        if channel.state is not None:
            column = packed.values[:, index]
            seen = np.isfinite(column)
            values[seen, channel.state] = column[seen]
    return values, np.isfinite(values)


def teacher_forcing(model: Model, packed: Packed, blend: float = 1.0) -> Forcing:
    """Forcing of measured states with strength `blend`."""
    values, seen = measured_states(model, packed)
    return Forcing(np.where(seen, values, 0.0), blend * seen.astype(np.float64))


def scaling_of(model: Model, packed: Packed, trajectories: Trajectories) -> Scaling:
    """Scales of the residuals (see the module's text)."""
    log = np.array([c.noise is not None and c.noise.kind == "lognormal" for c in model.channels], dtype=bool)
    spread = np.array([_spread(trajectories, i, bool(log[i])) for i in range(len(model.channels))])
    stated = np.full(len(model.channels), np.nan)
    for i, channel in enumerate(model.channels):
        if channel.noise is not None:
            scale = channel.noise.scale
            stated[i] = np.sqrt(np.log1p(scale**2)) if log[i] else scale
        elif np.any(np.isfinite(packed.sd[:, i])):
            stated[i] = float(np.nanmedian(packed.sd[:, i]))
    known = np.isfinite(stated) & (stated > 0)
    level = float(np.mean(stated[known] / spread[known])) if known.any() else 1.0
    channel_scale = np.where(known, np.where(known, stated, 1.0) / level, spread)
    if model.complete:
        free = np.flatnonzero(~known).tolist()
        for i in free:
            alike = [j for j in free if model.channels[j].unit == model.channels[i].unit]
            channel_scale[i] = float(np.sqrt(np.mean(spread[alike] ** 2)))
    row_scale = np.broadcast_to(channel_scale, packed.values.shape).copy()
    own = np.isfinite(packed.sd) & (packed.sd > 0)
    if own.any():
        row_scale = np.where(own, np.where(own, packed.sd, 1.0) / level, row_scale)
    return Scaling(log, row_scale, channel_scale, level if known.all() and level > 0 else None)


def typical(residuals: Array) -> float:
    """1.4826 times the median absolute residual (the deviation, if they were normal); infinite if one is not finite."""
    if not np.isfinite(residuals).all():
        return float("inf")
    return 1.4826 * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


def _spread(trajectories: Trajectories, channel: int, log: bool) -> float:
    """Standard deviation of a channel's data (of their logarithms); 1 or the values' size where they do not vary."""
    values = np.concatenate([item.values[:, channel] for item in trajectories.items] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    if log:
        values = np.log(values[values > 0])
    if len(values) == 0:
        return 1.0
    deviation = float(values.std())
    size = float(np.abs(values).max())
    if deviation > 1e-9 * max(size, 1e-300):
        return deviation
    return size if size > 0 and not log else 1.0
