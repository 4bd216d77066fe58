"""The density of measured values, given predictions and constants, with its derivatives by both.

With the prediction f and the variance v of a value y, it contributes

    (log(2 pi v) + (y - f)^2/v)/2,

and under lognormal noise the same of log y and log f, and log y for the density of y itself. The variance is that of
the noise that the model states, or of the value's own column `sd_NAME`; where the noise is learned, both are added. An
average of n values has the variance v/n. Noises with a density of their own have that in its place (under Student's v
is the square of the scale). A limit, below or above which the measured value lies, contributes minus the logarithm of
its probability.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import sympy
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.training.population import Families, Measured, Rows, shape_parameter, single_variance

LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Density:
    """The measured values [m] of a model; `noise` has the standard deviations of channels that do not state theirs."""

    model: Model
    measured: Measured
    noise: Mapping[str, float]

    def unknown(self) -> list[str]:
        """The channels with values whose standard deviation is not known."""
        bare = [i for i in range(len(self.model.channels)) if not self._known(i)]
        lacking = np.isin(self.measured.channel, bare) & (self.measured.sd <= 0)
        return [self.model.channels[i].name for i in sorted(set(self.measured.channel[lacking].tolist()))]

    def compared(self, mean: Tensor, constants: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals and standard deviations [m], both of logarithms under lognormal noise, at predictions [m] and the
        constants [m, K] of their trajectories."""
        logs = torch.from_numpy(self.measured.logarithm)
        safe = torch.where(logs, mean, torch.ones_like(mean))
        f = torch.where(logs, torch.log(safe), mean)
        return f - torch.from_numpy(self.measured.value), torch.sqrt(self._variance(mean, constants))

    def standardised(self, mean: Tensor, constants: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals in standard deviations, and these [m]; half the square of that of a limit is minus the logarithm
        of its probability."""
        residual, sd = self.compared(mean, constants)
        side = torch.from_numpy(self.measured.side)
        logs = torch.special.log_ndtr(side * residual / sd)
        return torch.where(side == 0, residual / sd, -side * torch.sqrt(-2 * logs)), sd

    def half(self, mean: Tensor, constants: Tensor) -> Tensor:
        """The contributions [m] to the negative log likelihood."""
        residual, sd = self.compared(mean, constants)
        side = torch.from_numpy(self.measured.side)
        value, more = self.measured.value, self.measured.more
        jacobian = torch.from_numpy(
            np.where(self.measured.logarithm & (self.measured.side == 0), value * (1 + more), 0.0)
        )
        normal = 0.5 * LOG_2PI + torch.log(sd) + 0.5 * (residual / sd) ** 2 + jacobian + self._of_replicates(sd)
        normal = torch.where(side == 0, normal, -torch.special.log_ndtr(side * residual / sd))
        families = Families(self.model, self.measured.channel)
        if not families:
            return normal
        number, shape = torch.from_numpy(self.measured.weight**2), self._shape(constants)
        rows = Rows(mean, torch.from_numpy(value), sd**2, torch.zeros_like(sd), shape, number)
        return families.put(normal, rows, lambda family, of: 0.5 * family.minus_two_log(of))

    def _of_replicates(self, sd: Tensor) -> Tensor:
        """What the deviations of replicates from their averages, of the standard deviation `sd`, contribute [m]."""
        more, scatter = torch.from_numpy(self.measured.more), torch.from_numpy(self.measured.scatter)
        single = sd**2 * (1 + more)
        return 0.5 * (more * (LOG_2PI + torch.log(single)) + scatter / single + torch.log1p(more))

    def slopes(self, mean: Array, constants: Array) -> tuple[float, Array, Array]:
        """The negative log likelihood, its derivatives by the predictions [m] and by the constants [m, K]."""
        f = torch.from_numpy(mean).requires_grad_()
        k = torch.from_numpy(constants).requires_grad_()
        total = self.half(f, k).sum()
        by_mean, by_constants = torch.autograd.grad(total, (f, k), allow_unused=True)
        parts = [np.zeros_like(x) if d is None else d.numpy() for d, x in ((by_mean, mean), (by_constants, constants))]
        return float(total.detach()), parts[0], parts[1]

    def _known(self, channel: int) -> bool:
        one = self.model.channels[channel]
        return one.noise is not None or one.name in self.noise

    def _shape(self, constants: Tensor) -> Tensor:
        """The shapes [m] of noises with a density of their own, 1 of others."""
        out = torch.ones(len(constants), dtype=torch.float64)
        for channel in range(len(self.model.channels)):
            rows = torch.from_numpy(np.flatnonzero(self.measured.channel == channel))
            table = constants[rows]
            known = {k.symbol: table[:, i] for i, k in enumerate(self.model.learnables)}
            found = shape_parameter(self.model, channel, known, out[rows])
            out = out.index_add(0, rows, found - 1)
        return out

    def _variance(self, mean: Tensor, constants: Tensor) -> Tensor:
        measured, out = self.measured, torch.zeros_like(mean)
        own = torch.from_numpy(measured.sd**2)
        names: dict[sympy.Symbol, int] = {k.symbol: i for i, k in enumerate(self.model.learnables)}
        for channel, one in enumerate(self.model.channels):
            rows = torch.from_numpy(np.flatnonzero(measured.channel == channel))
            if not len(rows):
                continue
            learned = one.noise is not None and one.noise.value is not None
            if one.noise is None:
                stated = torch.full_like(mean[rows], self.noise.get(one.name, float("nan")) ** 2)
            else:
                table = constants[rows]
                stated = single_variance(self.model, channel, mean[rows], {n: table[:, i] for n, i in names.items()})
            given, average = own[rows], stated / torch.from_numpy(measured.weight[rows.numpy()] ** 2)
            found = average + given if learned else torch.where(given > 0, given, average)
            out = out.index_add(0, rows, found)
        return out
