"""The measurement noise that a fit estimated, at predicted values, and the intervals that follow from it.

The noise of a lognormal channel is that of its logarithm: its standard deviation is proportional to the measured value,
and an interval extends by the same factor upwards and downwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import count_quantile, counted_channels, logarithmic, noise_form
from gbspec.runs import NORMAL_90

if TYPE_CHECKING:
    from gbspec.data import Trajectory
    from gbspec.ir import Channel, Expr, Model
    from gbspec.runs import FitRecord, Run


def noise_at(run: Run, values: Array) -> Array:
    """The standard deviation [..., C] of a measurement of channels at `values` [..., C], in their own units: under
    Student's noise that of a normal one with the same 90 % interval, of counts that of the distribution."""
    found = residual_noise(run.model, run.fit, values)
    return np.asarray(found * np.where(logarithmic(run.model), np.abs(values), 1.0), dtype=np.float64)


def measured_deviations(run: Run, item: Trajectory, estimated: Sequence[int]) -> dict[int, float]:
    """The standard deviation of each initial state that the first row of a trajectory gives, without the `estimated`
    ones: that of its measurement. None has a deviation of zero, and states that are absent have none."""
    from gbspec.data import absent_states  # with sympy, which not every command needs

    if not len(item.times) or item.times[0] != item.start:
        return {}
    values, out = item.values[0], dict[int, float]()
    (absent,) = absent_states(run.model, [item])
    deviations = noise_at(run, at_least_one(run.model, np.where(np.isfinite(values), values, 0.0)))
    for j, channel in enumerate(run.model.channels):
        if channel.state is None or channel.state in estimated or not np.isfinite(values[j]) or absent[channel.state]:
            continue
        stated = item.sd[0, j]
        deviation = stated if np.isfinite(stated) else deviations[j] / np.sqrt(max(item.counts[0, j], 1))
        if deviation > 0 and not run.model.states[channel.state].initial.known:
            out[channel.state] = float(deviation)
    return out


def residual_noise(model: Model, fit: FitRecord, values: Array) -> Array:
    """The same of a residual: of the logarithm, for channels with a lognormal noise."""
    found = np.zeros(np.shape(values))
    known = _known(model, fit) if _learned(model) else {}
    for i, channel in enumerate(model.channels):
        stated, place = _stated(channel, known), np.asarray(values)[..., i]
        deviation = (fit.noise.get(channel.name) or 0.0) if stated is None else _at(stated, channel, place)
        found[..., i] = deviation * _wider(channel, known)
    return found


def depends_on_value(model: Model, fit: FitRecord) -> bool:
    """Whether the noise of a channel is learned as an expression of the predicted value."""
    from gbspec.ir import PREDICTION

    stated = (_stated(channel, _known(model, fit)) for channel in model.channels) if _learned(model) else ()
    return any(one is not None and one.has(PREDICTION) for one in stated)


def _learned(model: Model) -> bool:
    return any(channel.noise is not None and channel.noise.value is not None for channel in model.channels)


def _known(model: Model, fit: FitRecord) -> dict[Expr, float]:
    """The values of constants and learnables by their symbols."""
    from gbspec.ir import symbol

    known: dict[Expr, float] = {c.symbol: c.value for c in model.constants}
    return known | {symbol(name): one.value for name, one in fit.constants.items() if one.value is not None}


def _stated(channel: Channel, known: Mapping[Expr, float]) -> Expr | None:
    """The expression of a noise in the predicted value alone; None where it states none, or holds what is implied."""
    if channel.noise is None or channel.noise.value is None:
        return None
    import sympy  # only here: `--version` and the like need none of it

    from gbspec.ir import PREDICTION

    found = channel.noise.value.xreplace({s: sympy.Float(value) for s, value in known.items()})
    return found if found.free_symbols <= {PREDICTION} else None


def _at(stated: Expr, channel: Channel, values: Array) -> Array:
    import sympy

    from gbspec.ir import PREDICTION

    assert channel.noise is not None
    function = sympy.lambdify([PREDICTION], stated, modules="numpy", dummify=True)
    with np.errstate(all="ignore"):
        found = np.broadcast_to(np.asarray(function(values), dtype=np.float64), np.shape(values))
    return np.sqrt(np.log1p(found**2)) if channel.noise.kind == "lognormal" else found


def at_least_one(model: Model, values: Array) -> Array:
    """Values [..., C] at which to take the noise of measured counts: of a count of 0 the expectation is not known to be
    0."""
    return np.where(counted_channels(model), np.maximum(values, 1.0), values)


def _wider(channel: Channel, known: Mapping[Expr, float]) -> float:
    """The 90 % interval of Student's noise, in units of that of a normal one whose standard deviation is the scale."""
    form = noise_form(channel)
    if form is None or channel.noise is None or channel.noise.shape is None:
        return 1.0
    import sympy

    upper = form.upper(float(channel.noise.shape.xreplace({s: sympy.Float(value) for s, value in known.items()})))
    return 1.0 if upper is None else upper / NORMAL_90


def interval(
    mean: Array, sd: Array, in_logarithms: Mask | bool, half: float = NORMAL_90, counted: Mask | bool = False
) -> tuple[Array, Array]:
    """The 90 % interval around `mean`: both ends, of the same shape, `half` the width in standard deviations away;
    multiplicative for noise of logarithms, which has no interval (NaN) around values that are not positive, except that
    of an exact zero: an absent state. Of counts (`counted`) both ends are quantiles of the distribution with this
    mean and standard deviation (`gbspec.ir.count_quantile`), whole numbers from 0, and so belong to the interval."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factor = np.exp(half * sd / mean)
        factor = np.where((mean > 0) & np.isfinite(factor), factor, np.where((mean == 0) & (sd == 0), 1.0, np.nan))
        low = np.where(in_logarithms, mean / factor, mean - half * sd)
        high = np.where(in_logarithms, mean * factor, mean + half * sd)
    which = np.broadcast_to(counted, mean.shape)
    if which.any():
        from scipy.special import ndtr  # not every command needs it

        for end, probability in ((low, float(ndtr(-half))), (high, float(ndtr(half)))):
            end[which] = count_quantile(probability, mean[which], sd[which] ** 2)
    return low, high
