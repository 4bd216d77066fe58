"""Predictions of new trajectories: their own parameters are estimated from the first rows, the other rows predicted.

The weights, and the constants that all trajectories share, stay as learned. Only the rows in the window of a trajectory
are used; later measurements are only compared with the predictions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import polars as pl

from gbspec.analysis.prediction.below_zero import said_of_ends
from gbspec.analysis.prediction.displaced import Displaced, Refit, unchanged
from gbspec.analysis.prediction.estimate import estimator_of
from gbspec.analysis.prediction.noise import interval, measured_deviations, noise_at
from gbspec.analysis.prediction.solutions import (
    Prediction,
    Start,
    learned_positions,
    learned_start,
    predict,
    started,
)
from gbspec.analysis.prediction.trained import Trained
from gbspec.analysis.prediction.window import first_rows, window_rows
from gbspec.arrays import Array, Mask
from gbspec.data import TRAJECTORY, present_values
from gbspec.diagnostics import ComputationError
from gbspec.files import finite
from gbspec.frames import Tabled, counted
from gbspec.ir import logarithmic, on_fitted_scale, slopes
from gbspec.runs import said_of_training

if TYPE_CHECKING:
    from gbspec.backends import Evaluator
    from gbspec.data import Scales, Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Covariance, Run

Use = Literal["training", "window", "predicted"]
"""The use of a row: in training, in the estimation of the initial state, or none."""

NUDGE = 1e-3
"""The step of the finite differences that propagate the uncertainty of an initial value or constant, in units of its
standard deviation: the prior one, or that of the measurement."""


@dataclass(frozen=True)
class PredictedTrajectory:
    """One trajectory: the mean of V variables at its R rows, and the standard deviation of a new measurement.

    `measured` [R, C] are the values to compare with, without those of absent states; `used` gives the use of each row,
    `outside` the quantities outside their trained ranges in it; `in_logarithms` [V] marks the variables whose intervals
    are multiplicative.
    """

    label: str
    times: Array
    mean: Array
    sd: Array
    measured: Array
    used: tuple[Use, ...]
    outside: tuple[tuple[str, ...], ...]
    start: Start
    estimated: tuple[str, ...]
    in_logarithms: Mask
    failure: str = ""

    @property
    def low(self) -> Array:
        """Lower end of the 90 % interval [R, V]."""
        return interval(self.mean, self.sd, self.in_logarithms)[0]

    @property
    def high(self) -> Array:
        """Upper end of the 90 % interval [R, V]."""
        return interval(self.mean, self.sd, self.in_logarithms)[1]


@dataclass(frozen=True)
class Errors:
    """Errors at the `n` measurements that were not used; `covered` is the fraction of them inside the intervals.

    `rmse` is in the channel's unit; `nrmse` is relative to the standard deviation of these measurements, both of
    logarithms where the noise is log-normal (`logarithms`).
    """

    n: int
    rmse: float
    nrmse: float
    covered: float
    logarithms: bool = False

    def to_json(self) -> dict[str, object]:
        """The errors as JSON; undefined numbers are null, and `logarithms` is there where these are compared."""
        numbers = {name: finite(getattr(self, name)) for name in ("rmse", "nrmse", "covered")}
        return {"n": self.n, **numbers, **({"logarithms": True} if self.logarithms else {})}

    def __str__(self) -> str:
        what = counted(self.n, "measurement that was not used", "measurements that were not used")
        relative = f"{self.nrmse:.3g} of their standard deviation"
        if self.logarithms:
            relative = f"that of logarithms {self.nrmse:.3g} of the standard deviation of theirs"
        inside = f"{100 * self.covered:.0f} % inside the 90 % intervals"
        return f"{what}; rmse {self.rmse:.4g}, {relative}, {inside}"


@dataclass(frozen=True, repr=False)
class Forecast(Tabled):
    """The predictions of a run for a table. `variables` are the channels, then the states that are not channels."""

    variables: tuple[str, ...]
    channels: tuple[str, ...]
    states: tuple[str, ...]
    items: tuple[PredictedTrajectory, ...]
    members: int
    warnings: tuple[str, ...] = ()
    time: str = "t"

    def to_frame(self) -> pl.DataFrame:
        """Columns `trajectory`, the time, NAME, NAME_low and NAME_high of each variable, `used` and `outside`.

        `used` is `training`, `window` (initial states and own constants were estimated from this row) or `predicted`;
        `outside` names the states and conditions that lie beyond the range in which the model was trained.
        """
        times = np.concatenate([np.zeros(0), *(item.times for item in self.items)])
        columns: dict[str, pl.Series] = {
            TRAJECTORY: pl.Series([item.label for item in self.items for _ in item.times], dtype=pl.String),
            self.time: pl.Series(times, dtype=pl.Float64),
        }
        for j, name in enumerate(self.variables):
            for suffix, which in (("", "mean"), ("_low", "low"), ("_high", "high")):
                values = np.concatenate([np.zeros(0), *(getattr(item, which)[:, j] for item in self.items)])
                columns[name + suffix] = pl.Series(values, dtype=pl.Float64).fill_nan(None)
        columns["used"] = pl.Series([use for item in self.items for use in item.used], dtype=pl.String)
        outside = [" ".join(names) for item in self.items for names in item.outside]
        return pl.DataFrame({**columns, "outside": pl.Series(outside, dtype=pl.String)})

    def summary(self) -> str:
        """What was predicted, and by how many members."""
        return f"{counted(len(self.items), 'trajectory')}, {', '.join(self.variables)}, members: {self.members}"

    def notes(self) -> Sequence[str]:
        """The errors and remarks of the text."""
        return str(self).split("\n")

    def errors(self) -> dict[str, Errors]:
        """The errors of each channel with measurements in rows that were not used."""
        found = {}
        for j, name in enumerate(self.channels):
            parts = [(item, [use == "predicted" for use in item.used]) for item in self.items if not item.failure]
            measured = np.concatenate([np.zeros(0), *(item.measured[rows, j] for item, rows in parts)])
            mean, low, high = (
                np.concatenate([np.zeros(0), *(getattr(item, which)[rows, j] for item, rows in parts)])
                for which in ("mean", "low", "high")
            )
            seen = np.isfinite(measured) & np.isfinite(mean)
            if seen.any():
                rmse = float(np.sqrt(np.mean((measured - mean)[seen] ** 2)))
                log = any(bool(item.in_logarithms[j]) for item, _ in parts)
                values, predicted = on_fitted_scale(measured[seen], mean[seen], log)
                width = float(np.nanstd(values))
                inside = (measured >= low) & (measured <= high)
                relative = float(np.sqrt(np.nanmean((values - predicted) ** 2))) / width if width > 0 else math.nan
                found[name] = Errors(int(seen.sum()), rmse, relative, float(np.mean(inside[seen])), log)
        return found

    def to_json(self) -> dict[str, object]:
        """The document of `predict --json`."""
        return {
            "members": self.members,
            "trajectories": [
                {
                    "trajectory": item.label,
                    "start": item.start.origin,
                    "estimated": list(item.estimated),
                    "initial": dict(zip(self.states, map(finite, item.start.state), strict=True)),
                    "rows": {use: item.used.count(use) for use in ("training", "window", "predicted")},
                    "failure": item.failure or None,
                }
                for item in self.items
            ],
            "channels": {name: one.to_json() for name, one in self.errors().items()},
            "warnings": list(self.warnings),
        }

    def __str__(self) -> str:
        lines = [f"{name}: {one}" for name, one in self.errors().items()]
        for origin, words in ORIGINS.items():
            of_it = [item for item in self.items if item.start.origin == origin]
            if of_it:
                what = ", ".join(dict.fromkeys(name for item in of_it for name in item.estimated))
                lines.append(f"{counted(len(of_it), 'trajectory')}: {words}" + (f" ({what})" if what else ""))
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


ORIGINS = {
    "learned": "part of the training data: predicted from the learned initial state",
    "known": "the initial state is given by the first row and the model",
    "estimated": "what is unknown was estimated from the first rows, with all shared parameters held fixed",
    "smoothed": "shown by all measurements; `--window N` predicts the rows after the first N from these",
    "failed": "no initial state was found from which it can be solved",
}


def forecast(run: Run, trajectories: Trajectories, *, window: int | None = None) -> Forecast:
    """Predictions of all members for every row of a table.

    `window` is the number of measured rows from which the initial state of a new trajectory is estimated (None: a
    third of them, at least three). Initial values that the first row measures are then estimated too, unless the window
    is that row alone; without `window` they are taken from it. A trajectory of the training data, recognised by
    content, has its learned initial state. The interval is that of a new measurement: it includes the variance over the
    members, the (linearised) uncertainties of the estimates and of the learned model (not for trajectories of the
    training data, whose starts were learned with it), and the noise that the fit estimated.

    Raises ComputationError if no trajectory can be solved.
    """
    from gbspec.backends import Evaluator

    scales = run.fit.scales_for(run.model, trajectories)
    released = window is not None and window > 1
    known = [run.certainties(number).covariance for number in run.numbers]
    each = [
        _MemberPredictions(Evaluator(member), run, trajectories, scales, covariance, released)
        for member, covariance in zip(run.members, known, strict=True)
    ]
    trained = Trained.of(run)
    present = present_values(run.model, trajectories).items
    joined = (_joined(each, index, window, trained) for index in range(len(trajectories)))
    items = tuple(replace(one, measured=item.values) for one, item in zip(joined, present, strict=True))
    if items and all(item.failure for item in items):
        first = items[0]
        raise ComputationError(
            f"no trajectory can be predicted: {first.failure}", where=f"trajectory {first.label}",
            remedy="give a longer `--window`, or run `gbspec validate` on the training data",
        )  # fmt: skip
    hidden = hidden_states(run.model)
    return Forecast(
        variables=(*trajectories.channels, *(run.model.states[i].name for i in hidden)),
        channels=trajectories.channels,
        states=tuple(state.name for state in run.model.states),
        items=items,
        members=len(each),
        time=run.model.time.name,
        warnings=(
            *said_of_items(items, _narrow(run.model) if len(each) == 1 and known[0] is None else ""),
            *_without_effect(items, window),
            *(said_of_training(run.fit.members) if any("predicted" in item.used for item in items) else ()),
            *said_of_ends(run.model, items, hidden),
        ),
    )


def hidden_states(model: Model) -> tuple[int, ...]:
    """The states whose names are not names of channels."""
    named = {channel.name for channel in model.channels}
    return tuple(i for i, state in enumerate(model.states) if state.name not in named)


def _narrow(model: Model) -> str:
    """What intervals lack where there is neither a covariance nor a spread of members."""
    if model.marginal:  # members would start elsewhere and end at the same maximum of the likelihood
        return (
            "the intervals contain the noise and the uncertainty of what trajectories have of their own, but not that "
            "of what they share, such as medians and spreads: they are rather too narrow"
        )
    return (
        "the run has one member and no covariance, so that the intervals contain the noise and the uncertainty of "
        "the initial state, but not that of the learned model: they are too narrow (`gbspec train --members 5`)"
    )


def said_of_items(items: Sequence[PredictedTrajectory], narrow: str = "") -> list[str]:
    """Warnings of trajectories without predictions and of predictions far from the training data; `narrow` is what the
    intervals lack."""
    found = [f"trajectory `{item.label}` could not be predicted: {item.failure}" for item in items if item.failure]
    if narrow:
        found.append(narrow)
    beyond = [item.label for item in items if any(item.outside)]
    if beyond:
        listed = ", ".join(f"`{label}`" for label in beyond[:5]) + (", ..." if len(beyond) > 5 else "")
        found.append(
            f"predictions of {counted(len(beyond), 'trajectory')} ({listed}) leave the region of the training data: "
            "see `outside`"
        )
    return found


def _without_effect(items: Sequence[PredictedTrajectory], window: int | None) -> list[str]:
    """A warning about trajectories for which a requested window changes nothing."""
    if window is None:
        return []
    why = {
        "learned": ("it is part of the training data", "they are part of the training data"),
        "known": ("the model or the first row gives its start", "the model or the first row gives their starts"),
    }
    found = []
    for origin in ("learned", "known") if window > 1 else ("learned",):
        labels = [item.label for item in items if item.start.origin == origin]
        if labels:
            listed = ", ".join(f"`{label}`" for label in labels[:5]) + (", ..." if len(labels) > 5 else "")
            number, because = counted(len(labels), "trajectory"), why[origin][len(labels) > 1]
            found.append(f"the window has no effect on {number} ({listed}): {because}")
    return found


@dataclass(frozen=True)
class _View:
    """One member's prediction of one trajectory: mean [R, V], and variance [R, V] from the uncertainty of its start and
    of the learned model."""

    prediction: Prediction
    variables: Array
    variance: Array


class _MemberPredictions:
    """The predictions of one member for a table."""

    def __init__(
        self,
        evaluator: Evaluator,
        run: Run,
        trajectories: Trajectories,
        scales: Scales,
        covariance: Covariance | None,
        released: bool,
    ) -> None:
        self.evaluator, self.run, self.model, self.trajectories = evaluator, run, run.model, trajectories
        self.estimator = estimator_of(evaluator, run.model, run.fit, scales, released)
        self.positions = learned_positions(evaluator.instance, trajectories, run.fit.data)
        self.displaced = Displaced(evaluator.instance, covariance, frozenset(run.values))

    def view(self, index: int, rows: int) -> _View:
        """The prediction of a trajectory from its first `rows` rows."""
        item, position = self.trajectories.items[index], self.positions[index]
        seen = first_rows(item, rows)
        start = self.estimator.start(seen) if position is None else learned_start(self.evaluator, position, item)
        found, variables = self._solve(item, start)
        variance = np.zeros_like(variables)
        refitted: Refit = unchanged
        if start.origin == "estimated" and not found.failure:
            variance, refitted = self._uncertainty(item, seen, start, variables)
        # What training trajectories determine, their own start and the model together, has no further uncertainty.
        if start.origin in ("known", "estimated") and not found.failure:
            for state, deviation in measured_deviations(self.run, item, self.estimator.free(seen)).items():
                change = deviation * self._slope(item, start, deviation, state=state)
                variance = variance + refitted(change) ** 2

            def solve(evaluator: Evaluator, moved: Start) -> Array:
                # Initial values that are expressions, or steady states, follow from the displaced constants.
                begun = started(evaluator, item, moved.state, moved.constants, moved.origin)
                return self._solve(item, begun, evaluator)[1]

            variance = variance + self.displaced.variance(start, variables, solve, refitted)
        return _View(found, variables, variance)

    def _solve(self, item: Trajectory, start: Start, evaluator: Evaluator | None = None) -> tuple[Prediction, Array]:
        found = predict(self.evaluator if evaluator is None else evaluator, self.model, item, start)
        return found, np.concatenate([found.channels, found.states[:, list(hidden_states(self.model))]], axis=1)

    def _slope(
        self, item: Trajectory, start: Start, size: float, *, state: int | None = None, constant: int | None = None
    ) -> Array:
        """The derivative [R, V] of the solution by an initial value or a constant of this size, by differences."""
        sides, nudge = [], NUDGE * size
        for by in (nudge, -nudge):
            moved, constants = start.state.copy(), start.constants.copy()
            if state is not None:
                moved[state] += by
            if constant is not None:
                constants[constant] += by
            sides.append(self._solve(item, started(self.evaluator, item, moved, constants, start.origin))[1])
        return np.asarray((sides[0] - sides[1]) / (2 * nudge), dtype=np.float64)

    def _uncertainty(self, item: Trajectory, seen: Trajectory, start: Start, variables: Array) -> tuple[Array, Refit]:
        """The variance [R, V] from the covariance of the estimate, the diagonal of J (J'WJ + P)^-1 J', by differences;
        and how a change d of the solution that the shared parameters make is met by the estimate, which is refitted to
        the window: d - J (J'WJ + P)^-1 J'W d.

        W is the precision of the window's residuals (from the fit's noise, or their size if that is larger), P that of
        the prior.
        """
        free = [*self.estimator.free(seen)]
        own = list(self.estimator.own)
        scale = np.concatenate([self.estimator.start_sd(seen)[free], self.estimator.own_sd])
        columns = [self._slope(item, start, scale[k], state=free[k]) for k in range(len(free))]
        columns += [self._slope(item, start, scale[len(free) + k], constant=place) for k, place in enumerate(own)]
        moves = np.stack([by * column for by, column in zip(scale, columns, strict=True)], axis=-1)
        rows, channels = len(seen.times), seen.values.shape[1]
        predicted, scales = variables[:rows, :channels], self.estimator.scales
        factor = scales.factor(seen)
        measured = factor > 0
        misfit = self.estimator.residuals(seen, predicted)[measured]
        typical = float(np.sqrt(np.mean(misfit**2))) if measured.any() else 0.0
        deviation = self.estimator.deviation(predicted)
        if self.estimator.varying is None:
            deviation = np.maximum(deviation, max(typical, 1e-9))
        of_residuals = slopes(predicted, seen.values, factor, scales.log) / deviation
        weighted = (moves[:rows, :channels] * of_residuals[:, :, None])[measured]
        inverse = np.linalg.inv(weighted.T @ weighted + np.eye(len(scale)))

        def refitted(change: Array) -> Array:
            in_window = (change[:rows, :channels] * of_residuals)[measured]
            return np.asarray(change - moves @ (inverse @ (weighted.T @ in_window)), dtype=np.float64)

        return np.asarray(np.einsum("rvi,ij,rvj->rv", moves, inverse, moves), dtype=np.float64), refitted


def _joined(each: Sequence[_MemberPredictions], index: int, window: int | None, known: Trained) -> PredictedTrajectory:
    """The combined prediction of a trajectory by all members."""
    model, item = each[0].model, each[0].trajectories.items[index]
    own = bool(each[0].estimator.own)
    trained = each[0].positions[index] is not None
    fixed = not each[0].estimator.free(item) and not own
    rows = len(item.times) if trained else window_rows(item, fixed, window)
    views = [one.view(index, rows) for one in each]
    failure = "; ".join(dict.fromkeys(v.prediction.failure for v in views if v.prediction.failure))
    values = np.stack([v.variables for v in views])
    mean = values.mean(axis=0)
    between = values.var(axis=0, ddof=1) if len(views) > 1 else np.zeros_like(mean)
    channels = len(model.channels)
    added = np.pad(noise_at(each[0].run, mean[:, :channels]) ** 2, ((0, 0), (0, mean.shape[1] - channels)))
    sd = np.sqrt(between + np.mean([v.variance for v in views], axis=0) + added)
    states = np.mean([v.prediction.states for v in views], axis=0)
    first = views[0].prediction.start
    start = replace(first, state=np.mean([v.prediction.start.state for v in views], axis=0))
    estimated: tuple[str, ...] = ()
    if start.origin == "estimated":
        free = each[0].estimator.free(first_rows(item, rows))
        estimated = (*(f"{model.states[i].name}({model.time.name}0)" for i in free),
                     *(model.constant_names[i] for i in each[0].estimator.own))  # fmt: skip
    used: tuple[Use, ...] = tuple(
        "training" if trained else "window" if i < rows else "predicted" for i in range(len(item.times))
    )
    in_logarithms = np.pad(logarithmic(model), (0, mean.shape[1] - channels))
    outside = known.outside(model, item, states, first)
    return PredictedTrajectory(item.label, item.times, mean, sd, item.values, used, outside, start, estimated,
                               in_logarithms, failure)  # fmt: skip
