"""The likelihood of the measured values of each trajectory given its standard normal numbers z, and their joint modes.

With predictions f, residuals r = f - y, variances v (of a value; an average of n has v/n, and a value with an own
standard deviation adds its square), each trajectory's

    g(z) = sum(log(2 pi v) + r^2/v) + z^T z

is minus twice the logarithm of its joint density, apart from the constant of z. All derivatives are analytic; those of
f come from the engines. The inner problems, one for each trajectory, are solved side by side by Levenberg-Marquardt
with the expected Hessian of g/2

    H = I + sum((1/v + (v'/v)^2/2) f_z f_z^T)

where v' = dv/df: the Hessian of first order conditional estimation with interaction (Lindstrom and Bates 1990; Wang
2007). A value of which only a limit L is known contributes its probability instead (the method M3 of Beal 2001): with
s = -1 below and 1 above it and w = s (f - L)/sqrt(v), minus twice log Phi(w) to g, and to the weight of f_z f_z^T
m (m + w) (dw/df)^2 with m = phi(w)/Phi(w), the second derivative by w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import symbol
from gbspec.training.population.families import Families
from gbspec.training.population.family import Rows
from gbspec.training.population.groups import Groups
from gbspec.training.population.layout import Layout
from gbspec.training.population.noise import LEAST, shape_parameter, single_variance
from gbspec.training.population.predictions import Predictions

LOG_2PI = float(np.log(2 * np.pi))
FARTHEST = 1e100
"""Predictions at the nodes of a quadrature are at most so large: steps may be too long for constants far out."""
LEAST_POSITIVE = 1e-300
"""Predictions have at least the logarithm of this number."""
TOGETHER = 4096
"""Copies of trajectories are solved together up to so many: more would not be faster, and take more memory."""
ITERATIONS = 60
"""Largest number of iterations of the inner problems."""
AWAY = 1.5
"""How far from 0 further starts of the inner problems lie."""
RESTS, RESTS_WITH_NETWORKS = 1e-9, 1e-6
"""An inner problem has converged when its next step is shorter than this (z has the standard deviation 1). The error of
-2 log L is about as large; with networks, whose fit ends at falls of a tenth, less is enough."""
CLOSE = 0.03
"""When no step is longer than this, adaptive steps of the solver are held: others at each z would move g a little, and
hide its last falls."""
OF_STEPS = 0.1
"""The part of g by which other adaptive steps move it, in units of their tolerance."""
GLANCE = 8
"""Iterations after which those of further starts are left out that lead to a minimum known already, or a higher one."""
NEAR, HIGHER = 0.1, 3.0
"""A minimum is known already if z is closer than NEAR, and higher if g is by more than HIGHER above the least."""


@dataclass(frozen=True)
class Compared:
    """Predictions compared with values [m]: on the logarithmic scale where the noise is lognormal.

    `mean`, `residual`, `variance`, its derivative by the mean `slope` (all [m]), and the sensitivities `by_z` [m, q].
    Where the noise is Student's, `variance` is the square of its scale. `shape` [m] has the degrees of freedom of
    Student's noise and the size of negative binomial counts (elsewhere 1, without meaning).
    """

    mean: Tensor
    residual: Tensor
    variance: Tensor
    slope: Tensor
    by_z: Tensor
    shape: Tensor


class Likelihood:
    """The densities of a population's measured values at natural parameters [N, P], one row for each trajectory."""

    def __init__(self, layout: Layout, predictions: Predictions, groups: Groups | None = None) -> None:
        self.layout, self.predictions = layout, predictions
        measured = predictions.measured
        self.groups = Groups.of(layout, predictions.problem.packed.condition) if groups is None else groups
        self._copies: dict[int, Likelihood] = {1: self}
        self.trajectories, self.count = measured.trajectories, self.groups.count
        control = predictions.problem.control
        self.uncertain = 0.0 if control is None else OF_STEPS * control.rtol
        self.owner = torch.from_numpy(measured.owner)
        self.unit = torch.from_numpy(self.groups.unit[measured.owner])
        self.value = torch.from_numpy(measured.value)
        self.share = torch.from_numpy(1.0 / measured.weight**2)
        self.extra = torch.from_numpy(measured.sd**2)
        self.logs = torch.from_numpy(measured.logarithm)
        self.channels = [
            torch.from_numpy(np.flatnonzero(measured.channel == c)) for c in range(len(layout.model.channels))
        ]
        self.side = torch.from_numpy(measured.side)
        self.limited = bool(measured.side.any())
        self.families = Families(layout.model, measured.channel)
        # Of n replicates under normal noise n - 1 deviations from their average are independent of it.
        more = np.where(self.families.mask, 0.0, measured.more)
        self.replicated, self.more = bool(more.any()), torch.from_numpy(more)
        self.scatter = torch.from_numpy(np.where(more > 0, measured.scatter, 0.0))
        # The density of a value whose logarithm is normal has the factor 1/value.
        jacobian = np.where(measured.logarithm & (measured.side == 0), 2 * measured.value * (1 + more), 0.0)
        self.constant = self.sums(torch.from_numpy(jacobian + np.log1p(more)))

    def copies(self, count: int) -> Likelihood:
        """The likelihood of `count` copies of all trajectories, which are solved side by side; row i of copy c is row
        c N + i."""
        if count not in self._copies:
            groups = self.groups.copies(count)
            self._copies[count] = Likelihood(self.layout, self.predictions.copies(count), groups)
        return self._copies[count]

    def shares(self, total: int) -> list[int]:
        """How many of `total` copies are solved together: equal numbers, with fewer in the last."""
        times = -(-total * self.trajectories // TOGETHER)
        each = -(-total // max(1, min(times, total)))
        return [min(each, total - begin) for begin in range(0, total, each)]

    def sums(self, values: Tensor) -> Tensor:
        """Sums of values [m, ...] over each unit [units, ...]."""
        out = values.new_zeros((self.count, *values.shape[1:]))
        return out.index_add(0, self.unit, values)

    def individual(self, natural: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """`Layout.constants` of trajectories from the standard numbers z [units, size]."""
        return self.layout.constants(natural, self.groups.numbers(z))

    def compared(self, mean: Tensor, sensitivity: Tensor, slope: Tensor, natural: Tensor) -> Compared:
        """The comparison at predictions [m] and sensitivities [m, q] to constants, whose derivatives by the numbers of
        their trajectories are `slope` [N, q, width]."""
        by_z = self.groups.placed(torch.einsum("mq,mqz->mz", sensitivity, slope[self.owner]), self.owner)
        if bool(self.logs.any()):
            # Predictions of 0 and less have the logarithm of the least one, which nothing moves.
            gone = self.logs & (mean <= LEAST_POSITIVE)
            safe = torch.where(self.logs & ~gone, mean, 1.0)
            by_z = torch.where(gone[:, None], 0.0, by_z / safe[:, None])
            mean = torch.where(self.logs, torch.log(torch.where(gone, LEAST_POSITIVE, safe)), mean)
        with torch.enable_grad():
            f = mean if mean.requires_grad else mean.detach().requires_grad_()
            variance = self.variance(f, natural)
            (rate,) = torch.autograd.grad(variance.sum(), f, create_graph=mean.requires_grad, allow_unused=True)
        if not mean.requires_grad:
            variance = variance.detach()
        rate = torch.zeros_like(mean) if rate is None else rate
        return Compared(mean, mean - self.value, variance, rate, by_z, self.shape(natural))

    def shape(self, natural: Tensor) -> Tensor:
        """The shapes [m] of noises with a density of their own, 1 of others."""
        out = torch.ones(len(self.value), dtype=torch.float64)
        for channel, rows in enumerate(self.channels):
            found = shape_parameter(self.layout.model, channel, self._known(natural, rows), out[rows])
            out = out.index_add(0, rows, found - 1)
        return out

    def seen(self, of: Compared) -> Rows:
        """What is compared, for the families."""
        return Rows(of.mean, self.value, of.variance, of.slope, of.shape, 1 / self.share)

    def _known(self, natural: Tensor, rows: Tensor) -> dict[sympy.Symbol, Tensor]:
        """The parameters by symbol, for each of these values."""
        table = natural[self.owner[rows]]
        return {symbol(name): table[:, place] for name, place in self.layout.names.items()}

    def variance(self, mean: Tensor, natural: Tensor) -> Tensor:
        """The variances [m] of the measured values."""
        model, out = self.layout.model, torch.zeros_like(mean)
        for channel, rows in enumerate(self.channels):
            if not len(rows):
                continue
            logs = self.logs[rows]
            # In both branches of `where` derivatives must be finite: 0 times an infinite one is not a number.
            f = torch.where(logs, torch.exp(torch.where(logs, mean[rows], 0.0)), mean[rows])
            known = self._known(natural, rows)
            out = out.index_add(0, rows, single_variance(model, channel, f, known))
        return torch.clamp(out * self.share + self.extra + 0 * mean, min=LEAST)

    def single(self, variance: Tensor) -> Tensor:
        """The variances [m] of single measurements where those of the values, which may be averages, are `variance`."""
        return (variance - self.extra) / self.share + self.extra

    def joint(self, of: Compared, z: Tensor) -> Tensor:
        """g [N]."""
        terms = LOG_2PI + torch.log(of.variance) + of.residual**2 / of.variance
        terms = self.families.put(terms, self.seen(of), lambda family, rows: family.minus_two_log(rows))
        if self.limited:
            place, _ = self._limit(of)
            terms = torch.where(self.side == 0, terms, -2 * torch.special.log_ndtr(place))
        if self.replicated:
            single = of.variance / self.share
            terms = terms + self.more * (LOG_2PI + torch.log(single)) + self.scatter / single
        return self.sums(terms) + (z**2).sum(1) + self.constant

    def half_gradient(self, of: Compared, z: Tensor) -> Tensor:
        """The gradient of g/2 by z [N, q]."""
        by_mean = of.residual / of.variance + 0.5 * of.slope * (1 / of.variance - of.residual**2 / of.variance**2)
        by_mean = self.families.put(by_mean, self.seen(of), lambda family, rows: family.by_mean(rows))
        if self.limited:
            place, by = self._limit(of)
            by_mean = torch.where(self.side == 0, by_mean, -_mills(place) * by)
        if self.replicated:
            relative = self.more - self.scatter * self.share / of.variance
            by_mean = by_mean + 0.5 * of.slope / of.variance * relative
        return z + self.sums(by_mean[:, None] * of.by_z)

    def expected_hessian(self, of: Compared) -> Tensor:
        """H [N, q, q]."""
        weight = 1 / of.variance + 0.5 * (of.slope / of.variance) ** 2
        weight = self.families.put(weight, self.seen(of), lambda family, rows: family.expected(rows))
        if self.limited:
            place, by = self._limit(of)
            ratio = _mills(place)
            weight = torch.where(self.side == 0, weight, ratio * torch.clamp(ratio + place, min=0.0) * by**2)
        if self.replicated:
            weight = weight + 0.5 * self.more * (of.slope / of.variance) ** 2
        unit = torch.eye(of.by_z.shape[1], dtype=of.by_z.dtype)
        if not self.groups.shared:
            return unit + self.sums(weight[:, None, None] * of.by_z[:, :, None] * of.by_z[:, None, :])
        # The products of all values at once would take far more memory where units have many numbers.
        rows = [torch.nonzero(self.unit == c)[:, 0] for c in range(self.count)]
        return torch.stack([unit + (of.by_z[r] * weight[r, None]).T @ of.by_z[r] for r in rows])

    def _limit(self, of: Compared) -> tuple[Tensor, Tensor]:
        """w [m] of limits, in whose place known values have 0, and dw/df."""
        side, root = self.side, torch.sqrt(of.variance)
        place = torch.where(side == 0, torch.zeros_like(root), side * of.residual / root)
        return place, torch.where(side == 0, torch.zeros_like(root), side / root - 0.5 * place * of.slope / of.variance)

    # ---------------------------------------------------------------- inner problems
    def at(self, natural: Tensor, z: Tensor, weights: Array) -> Compared:
        """The comparison with first derivatives alone; not differentiable."""
        with torch.no_grad():
            constants, slope = self.individual(natural, z)
        mean, sensitivity = self.predictions.first(constants.numpy(), weights)
        return self.compared(torch.from_numpy(mean), torch.from_numpy(sensitivity), slope, natural)

    def plain(self, natural: Tensor, z: Tensor, weights: Array) -> Compared:
        """The comparison without sensitivities, which are 0: enough for the density. Where a solution grows beyond all
        bounds, the density is as good as 0."""
        with torch.no_grad():
            constants, slope = self.individual(natural, z)
        mean = bounded(torch.from_numpy(self.predictions.individuals.mean(constants.numpy(), weights)))
        return self.compared(mean, mean.new_zeros((len(mean), self.layout.effects)), slope, natural)

    def lowest(self, natural: Tensor, z: Tensor, weights: Array) -> tuple[Tensor, Compared]:
        """The lowest of the minima of g that are found from `z`, from 0, and from both sides of 0 along each number:
        with networks there may be several."""
        best, of = self.modes(natural, z, weights)
        value = self._joint(of, best)
        other, least = best, value + HIGHER
        unit = AWAY * torch.eye(z.shape[1], dtype=z.dtype)
        for start in (0 * unit[0], *unit, *-unit) if z.shape[1] else ():
            near, there = self.modes(natural, start.expand_as(z).clone(), weights, GLANCE)
            reached = self._joint(there, near)
            better = (reached < least) & ((near - best).abs().amax(1) > NEAR)
            other, least = torch.where(better[:, None], near, other), torch.where(better, reached, least)
        if other is best or bool((other == best).all()):
            return best, of
        other, there = self.modes(natural, other, weights)
        better = self._joint(there, other) < value - 1e-6
        return torch.where(better[:, None], other, best), self._chosen(better, there, of)

    def modes(self, natural: Tensor, z: Tensor, weights: Array, most: int = ITERATIONS) -> tuple[Tensor, Compared]:
        """The minima of g from `z` [N, q], side by side, and the comparison there, after at most so many iterations."""
        rests = RESTS_WITH_NETWORKS if len(weights) else RESTS
        if self.predictions.problem.control is None or not z.shape[1]:
            return self._descended(natural, z, weights, most, rests)
        if not self.predictions.holdable:
            return self._descended(natural, z, weights, most, max(rests, self.uncertain))
        z, _ = self._descended(natural, z, weights, most, CLOSE)
        with torch.no_grad():
            constants = self.individual(natural, z)[0].numpy()
        with self.predictions.individuals.holding(constants, weights):
            return self._descended(natural, z, weights, most, rests)

    def _descended(
        self, natural: Tensor, z: Tensor, weights: Array, most: int, rests: float
    ) -> tuple[Tensor, Compared]:
        """The points from which no step is longer than `rests`, or that are reached after `most` iterations."""
        of = self.at(natural, z, weights)
        value, q = self._joint(of, z), z.shape[1]
        if not q:
            return z, of
        bad = ~torch.isfinite(value)
        if bool(bad.any()):  # a start from which the model cannot be solved: the median
            z = torch.where(bad[:, None], torch.zeros_like(z), z)
            of = self.at(natural, z, weights)
            value = self._joint(of, z)
        damping, missing = torch.zeros(self.count, dtype=z.dtype), torch.zeros((self.count, q, q), dtype=z.dtype)
        gradient, hessian = self.half_gradient(of, z), self.expected_hessian(of)
        for _ in range(most):
            step, whole = _step(gradient, hessian, missing, damping)
            missing = torch.where(whole[:, None, None], missing, torch.zeros_like(missing))
            if float(step.abs().max()) < rests:
                break
            trial = z + step
            new = self.at(natural, trial, weights)
            reached = self._joint(new, trial)
            # Beyond the rounding of g no further fall can be seen; there the step is that of Newton's method.
            better = (reached <= value + 1e-12 * (1 + value.abs())) & torch.isfinite(reached)
            if not bool(better.any()) and float(damping.max()) > 1e12:
                break
            damping = torch.where(better, damping * 0.1, torch.clamp(damping * 8, min=1e-2))
            damping = torch.where(damping < 1e-6, torch.zeros_like(damping), damping)
            z, of = torch.where(better[:, None], trial, z), self._chosen(better, new, of)
            value = torch.where(better, reached, value)
            before, gradient, hessian = gradient, self.half_gradient(of, z), self.expected_hessian(of)
            changed = _secant(missing, step, gradient - before - torch.einsum("nij,nj->ni", hessian + missing, step))
            missing = torch.where((better & torch.isfinite(changed).all(2).all(1))[:, None, None], changed, missing)
        return z, of

    def _joint(self, of: Compared, z: Tensor) -> Tensor:
        """g [units]; infinite where it or a sensitivity is not finite."""
        value = self.joint(of, z)
        lost = self.sums((~torch.isfinite(of.by_z)).any(1).to(value.dtype)) > 0
        return torch.where(lost | ~torch.isfinite(value), torch.full_like(value, torch.inf), value)

    def _chosen(self, which: Tensor, first: Compared, second: Compared) -> Compared:
        """The first comparison for some of the trajectories, the second for the others."""
        rows = which[self.unit]
        parts = {
            name: torch.where(rows[:, None] if value.ndim > 1 else rows, value, getattr(second, name))
            for name, value in vars(first).items()
        }
        return Compared(**parts)


def bounded(mean: Tensor) -> Tensor:
    """Predictions whose squares are finite numbers."""
    return torch.clamp(torch.nan_to_num(mean, nan=FARTHEST), -FARTHEST, FARTHEST)


def _mills(place: Tensor) -> Tensor:
    """phi(w)/Phi(w)."""
    return torch.exp(-0.5 * place**2 - 0.5 * LOG_2PI - torch.special.log_ndtr(place))


def _step(gradient: Tensor, hessian: Tensor, missing: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """The steps [N, q] by the Hessians with what they miss, or without where that is not positive definite; and where
    it is."""
    unit = torch.eye(gradient.shape[1], dtype=gradient.dtype)
    plain = hessian + damping[:, None, None] * unit
    zero = torch.zeros_like(plain)
    plain = torch.where(torch.isfinite(plain), plain, zero)
    full, info = torch.linalg.cholesky_ex(plain + torch.where(torch.isfinite(missing), missing, zero))
    half, other = torch.linalg.cholesky_ex(plain)
    good = ((info == 0) | (other == 0)) & torch.isfinite(gradient).all(1)
    factor = torch.where((info == 0)[:, None, None], full, half)
    safe = torch.where(good[:, None, None], factor, unit)
    right = torch.where(good[:, None], gradient, torch.zeros_like(gradient))
    return -torch.cholesky_solve(right[..., None], safe)[..., 0], info == 0


def _secant(missing: Tensor, step: Tensor, error: Tensor) -> Tensor:
    """What the expected Hessians miss, from the change of the gradients along a step: the least symmetric change that
    explains it (the secant condition of Powell, structured as by Dennis, Gay and Welsch 1981)."""
    size = (step**2).sum(1).clamp(min=1e-300)[:, None, None]
    outer = error[:, :, None] * step[:, None, :]
    along = (error * step).sum(1)[:, None, None]
    change = (outer + outer.transpose(1, 2)) / size - along * step[:, :, None] * step[:, None, :] / size**2
    return missing + change
