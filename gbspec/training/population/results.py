"""What a population fit tells: likelihood, spreads with intervals, individual estimates, residuals, a predictive check.

The covariance of estimates is the inverse of the expected information (`marginal`), with priors and ridge. Individual
estimates are the modes; their standard deviations follow from the inverse of the inner Hessian, and from the covariance
of the parameters (`uncertainty`). Shrinkage is one minus the standard deviation of the modes in units of the spread
(Karlsson and Savic 2007). Conditional weighted residuals are those of the model linearised at the modes (Hooker, Staatz
and Karlsson 2007): V^(-1/2) (y - f(z*) + F z*).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gbspec.arrays import Array, as_measured
from gbspec.runs import NORMAL_90, Covariance
from gbspec.training.optimise import tied_at_bounds
from gbspec.training.population.discrepancies import prediction_errors
from gbspec.training.population.groups import Groups, alike
from gbspec.training.population.layout import Layout
from gbspec.training.population.likelihood import Compared
from gbspec.training.population.objective import Objective, Point
from gbspec.training.population.predictions import Measured
from gbspec.training.population.uncertainty import of_parameters, of_shared
from gbspec.training.problem import Integers

BINS = 10
"""Most intervals of time in which a predictive check compares quantiles."""
REPLICATES, MOST = 500, 10_000_000
"""Simulated data sets of a predictive check, and the most values in all of them."""
LEVELS = (0.05, 0.5, 0.95)
"""The quantiles that a predictive check compares."""


@dataclass(frozen=True)
class Estimates:
    """Natural values of u by name, their standard deviations and 90 % intervals (NaN: not known), and covariance."""

    names: tuple[str, ...]
    value: Array
    sd: Array
    low: Array
    high: Array
    covariance: Array

    def at(self, name: str) -> int:
        """The place of a name."""
        return self.names.index(name)


@dataclass(frozen=True)
class PopulationResult:
    """The result at a point; arrays are those of `Measured` and of the distributed constants, in their order.

    `individual` [N, q] and `individual_sd` the constants of each trajectory; `deviations` [N, width] in units of the
    spreads, those of levels last, and their `shrinkage` [width]; `noise` [m] is the standard deviation of a single
    measurement, also where a value is an average; `table` [m, ...] by name: the population's and the
    trajectory's own predictions, and residuals. `used` is the number of parameters, of weights the effective one.
    `exact` is -2 log L by Laplace's method with the exact inner Hessian, NaN where that is not positive definite.
    `shared` is the covariance of weights and constants; None where it is not known. `loosened`, where parameters ended
    at bounds: how many times as large the standard deviations of those that the data tie to them would be with these
    free (1 for others, NaN for these).
    """

    point: Point
    ridge: float
    estimates: Estimates
    correlation: Array
    individual: Array
    individual_sd: Array
    deviations: Array
    shrinkage: Array
    noise: Array
    table: dict[str, Array]
    used: float
    exact: float
    shared: Covariance | None
    loosened: dict[str, float]


def result_at(
    objective: Objective, weights: Array, u: Array, z: Array, ridge: float, maximum: bool = True
) -> PopulationResult:
    """Everything at a point, whose modes are found from `z`. Where that is no `maximum`, standard deviations, which are
    those of estimates at one, are not known."""
    point = objective.at(weights, u, z, ridge, afresh=True)
    layout, likelihood = objective.layout, objective.marginal.likelihood
    covariance, estimates, tied = _with_bounds_held(objective, point, ridge) if maximum else _unknown(layout, point)
    natural = layout.natural(torch.from_numpy(point.u).expand(likelihood.trajectories, -1))
    modes = torch.from_numpy(point.z)
    of = likelihood.at(natural, modes, weights)
    with torch.no_grad():
        numbers = likelihood.groups.numbers(modes)
        constants, slope = layout.constants(natural, numbers)
        factor = layout.correlation_factor(natural)
        own = torch.einsum("nij,nj->ni", factor, numbers[:, : layout.effects])
        deviations = torch.cat([own, numbers[:, layout.effects :]], 1).numpy()
        correlation = (factor[0] @ factor[0].T).numpy() if layout.effects else np.zeros((0, 0))
    count, individual = len(weights), constants.numpy()[:, layout.place]
    spread = np.full_like(individual, np.nan)
    if maximum:
        posterior = likelihood.groups.of_trajectories(np.linalg.inv(likelihood.expected_hessian(of).numpy()))
        given = np.einsum("nij,njk,nik->ni", slope.numpy(), posterior, slope.numpy())
        spread = np.sqrt(given + of_parameters(objective, point, weights, covariance[count:, count:]))
    used = effective_weights(covariance[:count, :count], ridge)
    return PopulationResult(
        point,
        ridge,
        estimates,
        correlation,
        individual,
        spread,
        deviations,
        _shrinkage(likelihood.groups, deviations),
        np.sqrt(likelihood.single(of.variance).numpy()),
        _table(objective, point, of),
        used + len(point.u),
        objective.marginal.by_exact_hessian(point.u, weights, point.z) if maximum else np.nan,
        of_shared(layout, point.u, covariance, ridge) if maximum else None,
        tied,
    )


def _unknown(layout: Layout, point: Point) -> tuple[Array, Estimates, dict[str, float]]:
    """What `_with_bounds_held` returns, of a point that is no maximum."""
    count = len(point.weights)
    covariance = np.full((count + len(point.u),) * 2, np.nan)
    return covariance, _estimates(layout, point.u, covariance[count:, count:]), {}


def _with_bounds_held(objective: Objective, point: Point, ridge: float) -> tuple[Array, Estimates, dict[str, float]]:
    """The covariance [W + P, W + P] of (w, u), the estimates, and `loosened` of a result.

    Parameters that ended at a bound are held there: the others have the covariance of a fit without them, they
    themselves keep the standard deviation by which that was seen, and have none (NaN) in the covariance.
    """
    layout, u, count = objective.layout, point.u, len(point.weights)
    curvature = objective.curvature(point, ridge) / 2
    free = inverse(curvature)
    with np.errstate(invalid="ignore"):
        held = count + np.flatnonzero(layout.bijections.ended(u, np.sqrt(np.diag(free)[count:])))
    rest = curvature.copy()
    rest[held], rest[:, held] = 0.0, 0.0
    covariance = inverse(rest)
    factors = np.zeros(0)
    if len(held):
        slopes, clean = objective.gradient(point, ridge) / 2, np.nan_to_num(covariance)
        most = layout.bijections.lengths(u)[held - count]
        factors = tied_at_bounds(curvature, slopes, clean, np.sqrt(np.diag(free)), held, most)[count:]
    whole = covariance.copy()
    whole[held], whole[:, held] = 0.0, 0.0
    whole[held, held] = np.diag(free)[held]
    tied = dict(zip(layout.names, factors.tolist(), strict=False))
    return covariance, _estimates(layout, u, whole[count:, count:]), tied


def effective_weights(covariance: Array, ridge: float) -> float:
    """The effective number of weights, whose block of the inverse curvature is `covariance` [w, w], at a ridge.

    The trace of (H + R)^-1 H over the weights, where only R = ridge I belongs to the prior: w - ridge trace(covariance)
    (MacKay 1992), from 0 to w.
    """
    count = len(covariance)
    return float(np.clip(count - ridge * np.nan_to_num(np.trace(covariance), nan=0.0), 0.0, count))


def _shrinkage(groups: Groups, deviations: Array) -> Array:
    """One minus the standard deviation of the modes [N, width], of shared ones each counted once; NaN for one alone."""
    out = np.full(deviations.shape[1], np.nan)
    for k, column in enumerate(deviations.T):
        _, first = np.unique(np.stack([groups.unit, groups.slot[:, k]]), axis=1, return_index=True)
        if len(first) > 1:
            out[k] = 1 - column[first].std(ddof=1)
    return out


def inverse(matrix: Array) -> Array:
    """The inverse of an information; NaN for parameters of which there is none, which leave the others as they are."""
    known = np.flatnonzero(np.diag(matrix) > 0)
    inner, out = matrix[np.ix_(known, known)], np.full_like(matrix, np.nan)
    scale = np.sqrt(np.diag(inner))
    try:
        found = np.linalg.inv(inner / np.outer(scale, scale)) / np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return out
    out[np.ix_(known, known)] = np.where(np.isfinite(found), found, np.nan)
    return out


def _estimates(layout: Layout, u: Array, covariance: Array) -> Estimates:
    """Natural values; intervals are symmetrical on the scale on which parameters are trained."""
    at = torch.from_numpy(u)
    slopes = layout.bijections.derivative(u)
    with np.errstate(invalid="ignore"):
        own = np.sqrt(np.diag(covariance))
    value = layout.natural(at).numpy()
    ends = [layout.natural(torch.from_numpy(u + sign * NORMAL_90 * own)).numpy() for sign in (-1, 1)]
    scaled = covariance * np.outer(slopes, slopes)
    maps = layout.bijections.each
    told = [np.array([one.end(a, v) for one, a, v in zip(maps, end, value, strict=True)]) for end in ends]
    low, high = np.minimum(*told), np.maximum(*told)
    return Estimates(tuple(layout.names), value, np.abs(slopes) * own, low, high, scaled)


def _table(objective: Objective, point: Point, of: Compared) -> dict[str, Array]:
    """Predictions and residuals of every measured value."""
    layout, likelihood = objective.layout, objective.marginal.likelihood
    predictions = objective.marginal.predictions
    natural = layout.natural(torch.from_numpy(point.u).expand(likelihood.trajectories, -1))
    with torch.no_grad():
        typical = likelihood.individual(natural, torch.zeros_like(torch.from_numpy(point.z)))[0].numpy()
    population = predictions.individuals.mean(typical, point.weights)
    unit, residual = likelihood.unit.numpy(), -of.residual.numpy()
    by_z, variance = of.by_z.numpy(), of.variance.numpy().copy()
    own = residual / np.sqrt(variance)
    for family, some in likelihood.families.each:
        seen = likelihood.seen(of).at(some)
        own[some], variance[some] = family.normal_quantile(seen), family.equivalent(seen)
    weighted = np.full(len(unit), np.nan)
    known = np.flatnonzero(predictions.measured.side == 0)  # a limit has no residual
    for rows in alike(unit, known):
        f = by_z[rows]
        if not (np.isfinite(variance[rows]).all() and np.isfinite(f).all()):
            continue
        diagonal = variance[rows][:, :, None] * np.eye(rows.shape[1])
        values, vectors = np.linalg.eigh(diagonal + f @ f.swapaxes(1, 2))
        root = (vectors / np.sqrt(np.maximum(values, 1e-300))[:, None, :]) @ vectors.swapaxes(1, 2)
        shifted = residual[rows] + np.einsum("nkz,nz->nk", f, point.z[unit[rows[:, 0]]])
        weighted[rows] = np.einsum("nij,nj->ni", root, shifted)
    logs = predictions.measured.logarithm
    return {
        "value": as_measured(predictions.measured.value, logs),
        "individual": as_measured(of.mean.numpy(), logs),
        "population": population,
        "cwres": weighted,
        "iwres": np.where(predictions.measured.side == 0, own, np.nan),
    }


def simulated_tables(objective: Objective, point: Point, times: Array, seed: int) -> dict[str, Array]:
    """What simulated data sets tell: a visual predictive check, and prediction errors of every value (`npde`)."""
    measured = objective.marginal.predictions.measured
    simulated = simulate(objective, point, seed)
    with np.errstate(divide="ignore", invalid="ignore"):
        compared = np.where(measured.logarithm, np.log(simulated), simulated)
    errors = prediction_errors(measured.owner, measured.value, compared, measured.side == 0)
    return {**predictive_check(measured, simulated, times), "npde": errors}


def predictive_check(measured: Measured, simulated: Array, times: Array) -> dict[str, Array]:
    """Quantiles of measured and of simulated values by channel and interval of time: a visual predictive check.

    Rows are [channel, first time, middle, last time, measured quantiles, and for each of these the 5, 50 and 95 %
    quantile of the simulated ones]; simulated data sets have the trajectories, times and conditions of the data.
    """
    value = as_measured(measured.value, measured.logarithm)
    rows = []
    for channel in np.unique(measured.channel):
        here = np.flatnonzero((measured.channel == channel) & (measured.side == 0))
        if not len(here):
            continue
        for some in _bins(times[here]):
            pick = here[some]
            own = np.quantile(value[pick], LEVELS)
            found = np.nanquantile(simulated[:, pick], LEVELS, axis=1)
            bands = np.nanquantile(found, LEVELS, axis=1)
            t = times[pick]
            rows.append([channel, t.min(), np.median(t), t.max(), *own, *bands.T.ravel()])
    return {"check": np.array(rows, dtype=np.float64).reshape(-1, 16)}


def _bins(times: Array) -> list[Integers]:
    """Indices of values in intervals of time with about equal numbers of values."""
    edges = np.unique(np.quantile(times, np.linspace(0, 1, BINS + 1)))
    if len(edges) < 2:
        return [np.arange(len(times))]
    place = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(edges) - 2)
    return [np.flatnonzero(place == i) for i in range(len(edges) - 1) if (place == i).any()]


def simulate(objective: Objective, point: Point, seed: int) -> Array:
    """Simulated values [replicates, m] at the design of the data."""
    layout, likelihood = objective.layout, objective.marginal.likelihood
    rng = np.random.default_rng([seed, 67])
    count = max(20, min(REPLICATES, MOST // max(len(likelihood.value), 1)))
    natural = layout.natural(torch.from_numpy(point.u).expand(likelihood.trajectories, -1))
    out, begin = np.full((count, len(likelihood.value)), np.nan), 0
    shape, number = likelihood.shape(natural).numpy(), 1 / likelihood.share.numpy()
    for together in likelihood.shares(count):
        numbers, errors = [], []
        for _ in range(together):
            numbers.append(rng.standard_normal((likelihood.count, likelihood.groups.size)))
            error = rng.standard_normal(len(likelihood.value))
            for family, some in likelihood.families.each:
                error[some] = family.numbers(shape[some], rng)
            errors.append(error)
        several = likelihood.copies(together)
        rows = natural.repeat(together, 1)
        with torch.no_grad():
            constants, slope = several.individual(rows, torch.from_numpy(np.concatenate(numbers)))
        mean = torch.from_numpy(several.predictions.individuals.mean(constants.numpy(), point.weights))
        of = several.compared(mean, mean.new_zeros((len(mean), layout.effects)), slope, rows)
        place = np.empty((together, len(likelihood.value)), dtype=np.int64)
        place[:, likelihood.predictions.order] = several.predictions.order.reshape(together, -1)
        middle, variance, error = of.mean.numpy()[place], of.variance.numpy()[place], np.array(errors)
        drawn = middle + np.sqrt(variance) * error
        for family, some in likelihood.families.each:
            drawn[:, some] = family.drawn(error[:, some], middle[:, some], variance[:, some], number[some])
        out[begin : begin + together] = np.where(likelihood.logs.numpy(), np.exp(np.minimum(drawn, 700)), drawn)
        begin += together
    return out
