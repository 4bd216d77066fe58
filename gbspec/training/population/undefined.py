"""Where a likelihood, or its derivative, is not a finite number: what of it is not, and at which measured value."""

from __future__ import annotations

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.population.likelihood import Likelihood
from gbspec.training.population.objective import Point

_NOISE = (
    "bounds by which the noise is a positive finite number at each prediction, or another form of it "
    "(`noise normal(sqrt(a^2 + (b*y)^2))`)"
)
_ROOT = (
    "a noise whose square has a derivative there (`normal(sqrt(a^2 + b^2*y))` in place of `normal(a + b*sqrt(y))`), or "
    "empty cells in place of these values"
)


def undefined(likelihood: Likelihood, point: Point, gradient: Array | None, when: str) -> ComputationError | None:
    """The error to raise at a point where a likelihood (`gradient` None) or its gradient by (w, u) is not finite;
    None where predictions are not finite, which has another explanation. `when`: in which iteration of a stage."""
    layout = likelihood.layout
    natural = layout.natural(torch.from_numpy(point.u).expand(likelihood.trajectories, -1))
    of = likelihood.plain(natural, torch.from_numpy(point.z), point.weights)
    constants = likelihood.individual(natural, torch.from_numpy(point.z))[0].detach().numpy()
    mean = likelihood.predictions.individuals.mean(constants, point.weights)
    if not np.isfinite(mean).all():
        return None
    for wrong, what, remedy in (
        (of.variance, "is not a finite number", _NOISE),
        (of.slope, "has no finite derivative by the prediction", _ROOT),
    ):
        rows = np.flatnonzero(~np.isfinite(wrong.numpy()))
        if len(rows):
            channel, where = _place(likelihood, int(rows[0]), float(mean[rows[0]]))
            return ComputationError(f"the noise of `{channel}` {what}, {when}", where=where, remedy=remedy)
    if gradient is None:
        return ComputationError(f"the likelihood is not a finite number, {when}", remedy=_NOISE)
    names = [*(["weights of networks"] * len(point.weights)), *(f"`{name}`" for name in layout.names)]
    lost = dict.fromkeys(name for name, slope in zip(names, gradient, strict=True) if not np.isfinite(slope))
    by = f" by {', '.join(lost)}" if lost else ""
    return ComputationError(f"the derivative of the likelihood{by} is not a finite number, {when}", remedy=_NOISE)


def _place(likelihood: Likelihood, row: int, prediction: float) -> tuple[str, str]:
    """The channel of a measured value, and where it is."""
    problem, measured = likelihood.predictions.problem, likelihood.predictions.measured
    time = problem.packed.row_time[np.nonzero(problem.seen)[0][row]]
    channel = problem.model.channels[int(measured.channel[row])].name
    label = problem.packed.labels[int(measured.owner[row])]
    return channel, (
        f"trajectory `{label}` at {problem.model.time.name} = {time:.6g}, where the model has {channel} = "
        f"{prediction:.6g}"
    )
