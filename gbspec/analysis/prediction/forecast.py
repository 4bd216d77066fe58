"""Predictions of new trajectories: their own parameters are estimated from the first rows, the other rows predicted.

The weights, and the constants that all trajectories share, stay as learned. Only the rows in the window of a trajectory
are used; later measurements are only compared with the predictions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import polars as pl

from gbspec.analysis.prediction.below_zero import said_of_ends
from gbspec.analysis.prediction.defaults import said_of_defaults
from gbspec.analysis.prediction.far_outside import said_of_states
from gbspec.analysis.prediction.followed import missed, said_of_starts
from gbspec.analysis.prediction.grouped import said_of_groups
from gbspec.analysis.prediction.members import MemberPredictions
from gbspec.analysis.prediction.moving_jumps import said_of_moving_jumps
from gbspec.analysis.prediction.nearby import hidden_states
from gbspec.analysis.prediction.noise import interval, noise_at
from gbspec.analysis.prediction.restarted import said_of_restarts
from gbspec.analysis.prediction.solutions import ALIKE, BY_MODEL, ORIGINS, Start, labels_of
from gbspec.analysis.prediction.trained import Trained
from gbspec.analysis.prediction.window import window_rows
from gbspec.arrays import Array, Mask
from gbspec.data import TRAJECTORY, present_values
from gbspec.diagnostics import ComputationError
from gbspec.files import finite
from gbspec.frames import Tabled, counted
from gbspec.ir import ErrorScale, counted_channels, logarithmic
from gbspec.runs import NORMAL_90, said_of_training

if TYPE_CHECKING:
    from gbspec.analysis.prediction.followed import Missed
    from gbspec.data import Scales, Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Run

Use = Literal["training", "window", "predicted"]
"""The use of a row: in training, in the estimation of the initial state, or none."""

RELATIVE = 0.2
"""Differences of logarithms below this are told as relative errors; larger ones, of which these differ, as factors."""
ENOUGH, REFUTED = 10, 0.6
"""Of at least so many measurements fewer than this share lie inside 90 % intervals where a warning is given. It is a
sign and no test: errors of one trajectory are not independent of each other."""


REMEDY = (
    "A longer or a shorter `--window` may lead to another one; a start that is known can be given by the first row of "
    "the table (without `--window`) or by `initial` in the model"
)
"""What can be done about a start that does not lead along its rows."""


@dataclass(frozen=True)
class PredictedTrajectory:
    """One trajectory: the mean of V variables at its R rows, and the standard deviation of a new measurement.

    `measured` [R, C] are the values to compare with, without those of absent states; `used` gives the use of each row,
    `outside` the quantities outside their trained ranges in it; `in_logarithms` [V] marks the variables whose intervals
    are multiplicative, `counted` [V] those that are counts; `quantile` is half their width in standard deviations.
    `alike` is the label of the trajectory of the training data that has the same rows, if it is another one.
    `others` are further means and deviations [R, V], of rows that may be on the other side of an event. `scales` are
    those of errors of the channels.
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
    quantile: float = NORMAL_90
    counted: Mask | bool = False
    others: tuple[tuple[Array, Array], ...] = ()
    alike: str = ""
    scales: tuple[ErrorScale, ...] = ()

    @property
    def low(self) -> Array:
        """Lower end of the 90 % interval [R, V]."""
        return np.asarray(np.min([low for low, _ in self._ends], axis=0), dtype=np.float64)

    @property
    def high(self) -> Array:
        """Upper end of the 90 % interval [R, V]."""
        return np.asarray(np.max([high for _, high in self._ends], axis=0), dtype=np.float64)

    @property
    def _ends(self) -> list[tuple[Array, Array]]:
        sides = ((self.mean, self.sd), *self.others)
        return [interval(mean, sd, self.in_logarithms, self.quantile, self.counted) for mean, sd in sides]


@dataclass(frozen=True)
class Errors:
    """Errors at the `n` measurements that were not used; `covered` is the fraction of them inside the intervals.

    `rmse` is in the channel's unit; `nrmse` is relative to the standard deviation of these measurements, both of
    logarithms where the noise is log-normal (`logarithms`), as is `rmse_of_logarithms`. These leave out the
    `not_positive` predictions, which have no logarithm; their measurements are in no interval. Of `counts` `nrmse` is
    on the scale of their noise.
    """

    n: int
    rmse: float
    nrmse: float
    covered: float
    logarithms: bool = False
    rmse_of_logarithms: float = math.nan
    not_positive: int = 0
    counts: bool = False

    def to_json(self) -> dict[str, object]:
        """The errors as JSON; undefined numbers are null, and `logarithms` or `counts` is there where these are
        compared."""
        numbers = {name: finite(getattr(self, name)) for name in ("rmse", "nrmse", "covered")}
        more = {"logarithms": True, "rmse_of_logarithms": finite(self.rmse_of_logarithms)} if self.logarithms else {}
        more |= {"counts": True} if self.counts else {}
        more |= {"not_positive": self.not_positive} if self.not_positive else {}
        return {"n": self.n, **numbers, **more}

    def __str__(self) -> str:
        what = counted(self.n, "measurement that was not used", "measurements that were not used")
        # The standard deviation of equal measurements is 0.
        on_scale = " on the scale of their noise" if self.counts else ""
        relative = f", {self.nrmse:.3g} of their standard deviation{on_scale}" if math.isfinite(self.nrmse) else ""
        if self.logarithms:
            size = self.rmse_of_logarithms
            typical = f"error of {100 * size:.2g} %" if size < RELATIVE else f"factor of {math.exp(size):.2g}"
            left = f"; without {self.not_positive} whose prediction is not positive" if self.not_positive else ""
            relative = f"; of logarithms {size:.3g} (a typical {typical}{left})"
            if self.not_positive == self.n:
                relative = "; none of logarithms, as no prediction is positive"
        inside = f"{100 * self.covered:.0f} % inside the 90 % intervals"
        return f"{what}; rmse {self.rmse:.4g}{relative}, {inside}"


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

        `used` is `training`, `window` (this row gave initial states and own constants, or these were estimated from it)
        or `predicted`;
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
                scale = parts[0][0].scales[j]
                log, values, predicted = scale.logarithms, scale.measured(measured[seen]), scale.predicted(mean[seen])
                inside = (measured >= low) & (measured <= high)
                known = np.isfinite(values) & np.isfinite(predicted)
                width = float(np.std(values[known])) if known.any() else math.nan
                size = float(np.sqrt(np.mean((values - predicted)[known] ** 2))) if known.any() else math.nan
                relative, covered = size / width if width > 0 else math.nan, float(np.mean(inside[seen]))
                below, of_logs = int((mean[seen] <= 0).sum()) if log else 0, size if log else math.nan
                counts, n = scale.size is not None, int(seen.sum())
                found[name] = Errors(n, rmse, relative, covered, log, of_logs, below, counts)
        return found

    def to_json(self) -> dict[str, object]:
        """The document of `predict --json`."""
        return {
            "members": self.members,
            "trajectories": [
                {
                    "trajectory": item.label,
                    "start": item.start.origin,
                    "same_rows_as": item.alike or None,
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
        for words in (*ORIGINS.values(), BY_MODEL):
            of_it = [item for item in self.items if _origin(item) == words and not item.alike]
            if of_it:
                what = ", ".join(dict.fromkeys(name for item in of_it for name in item.estimated))
                lines.append(f"{counted(len(of_it), 'trajectory')}: {words}" + (f" ({what})" if what else ""))
        alike = [f"`{item.label}` as `{item.alike}`" for item in self.items if item.alike]
        lines += [f"{counted(len(alike), 'trajectory')}: {ALIKE} ({_some(alike)})"] if alike else []
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


def forecast(run: Run, trajectories: Trajectories, *, window: int | None = None) -> Forecast:
    """Predictions of all members for every row of a table.

    `window` is the number of measured rows from which the initial state of a new trajectory is estimated (None: a
    third of them, at least three). Initial values that the first row measures are then estimated too, unless the window
    is that row alone; without `window` they are taken from it. A trajectory of the training data, recognised by
    content, has its learned initial state, and without `window` also one that begins with all rows of such a one and
    goes on, with or without measurements. The interval is that of a new measurement: it includes the variance over the
    members, the (linearised) uncertainties of the estimates and of the learned model, and the noise that the fit
    estimated.

    Raises ComputationError if no trajectory can be solved.
    """
    from gbspec.backends import Evaluator

    scales = run.fit.scales_for(run.model, trajectories)
    released = window is not None and window > 1
    each = [
        MemberPredictions(Evaluator(run.member(number)), run, trajectories, scales, number, released)
        for number in run.numbers
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
    found = Forecast(
        variables=(*trajectories.channels, *(run.model.states[i].name for i in hidden)),
        channels=trajectories.channels,
        states=tuple(state.name for state in run.model.states),
        items=items,
        members=len(each),
        time=run.model.time.name,
        warnings=(
            *said_of_defaults(run, present),
            *said_of_restarts(run, trajectories),
            *said_of_items(items, _narrow(run.model) if len(each) == 1 and each[0].covariance is None else ""),
            *_without_effect(items, window),
            *said_of_moving_jumps(run),
            *said_of_groups(each[0].evaluator.instance, run.model, trajectories.items, items),
            *said_of_starts(_missed(run, scales, present, items), REMEDY),
            *(said_of_training(run.fit.members) if any("predicted" in item.used for item in items) else ()),
            *said_of_ends(run.model, items, hidden),
            *said_of_states(run.model, items, hidden),
        ),
    )
    return replace(found, warnings=(*found.warnings, *said_of_coverage(found.errors())))


def _missed(
    run: Run, scales: Scales, present: Sequence[Trajectory], items: Sequence[PredictedTrajectory]
) -> list[Missed | None]:
    """What the solutions from estimated starts miss of the rows that these were estimated from."""
    found, channels = [], len(run.model.channels)
    for item, one in zip(present, items, strict=True):
        if one.start.origin == "estimated" and not one.failure:
            rows = one.used.count("window")  # the first ones
            seen, mean = item.at_rows(slice(rows)), one.mean[:rows, :channels]
            found.append(missed(run.model, run.fit, scales, seen, mean))
    return found


def said_of_coverage(errors: Mapping[str, Errors]) -> list[str]:
    """A warning for each channel of which the measurements are hardly in agreement with the intervals."""
    return [
        f"{100 * one.covered:.0f} % of the values of `{name}` that were not used lie inside its 90 % intervals. Rows "
        "of one trajectory err together; where several trajectories do so, these rows show something that the model "
        "lacks, and no interval from the training data holds here: train with such rows too"
        for name, one in errors.items()
        if one.n >= ENOUGH and one.covered < REFUTED
    ]


def _narrow(model: Model) -> str:
    """What intervals lack where there is neither a covariance nor a spread of members: nothing where trajectories have
    no learned thing in common."""
    if not model.networks and not model.marginal and all(k.per_trajectory for k in model.learnables):
        return ""
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
    groups = {
        ("it is part of the training data", "they are part of the training data"): [
            item.label for item in items if item.start.origin == "learned" and not item.alike
        ],
        ("it has the same rows as one of the training data", "they have the same rows as some of the training data"): [
            item.label for item in items if item.start.origin == "learned" and item.alike
        ],
        ("the model gives its start", "the model gives their starts"): [
            item.label for item in items if _origin(item) == BY_MODEL and window > 1
        ],
        ("the model or the first row gives its start", "the model or the first row gives their starts"): [
            item.label for item in items if _origin(item) == ORIGINS["known"] and window > 1
        ],
    }
    given = "the window" if window > 1 else "a start at the first row (`--from-start`, or a window of one row)"
    return [
        f"{given} has no effect on {counted(len(labels), 'trajectory')} ({_some([f'`{label}`' for label in labels])}): "
        f"{why[len(labels) > 1]}"
        for why, labels in groups.items()
        if labels
    ]


def _origin(item: PredictedTrajectory) -> str:
    """What is said of the origin of a trajectory's start: of known ones whether a row is used for them."""
    given = item.start.origin == "known" and "window" not in item.used
    return BY_MODEL if given else ORIGINS[item.start.origin]


def _some(listed: Sequence[str]) -> str:
    """The first few of some texts."""
    return ", ".join(listed[:5]) + (", ..." if len(listed) > 5 else "")


def uses(rows: int, trained: int, window: int) -> tuple[Use, ...]:
    """The use of each of so many rows: those up to `window` in a window that was given, others of the first `trained`
    ones in the training."""
    return tuple("window" if i < window else "training" if i < trained else "predicted" for i in range(rows))


def _joined(each: Sequence[MemberPredictions], index: int, window: int | None, known: Trained) -> PredictedTrajectory:
    """The combined prediction of a trajectory by all members."""
    model, item = each[0].model, each[0].trajectories.items[index]
    own = bool(each[0].estimator.own)
    position, longer = each[0].positions[index], each[0].longer[index]
    trained = len(item.times) if position is not None else longer[1] if longer is not None else 0
    goes_on = bool(trained) and window is None
    fixed = not each[0].estimator.free(item) and not own
    rows = trained if position is not None or goes_on else window_rows(item, model, fixed, window)
    views = [one.view(index, rows, goes_on) for one in each]
    failure = "; ".join(dict.fromkeys(v.prediction.failure for v in views if v.prediction.failure))
    values = np.stack([v.variables for v in views])
    mean = values.mean(axis=0)
    between = values.var(axis=0, ddof=1) if len(views) > 1 else np.zeros_like(mean)
    channels = len(model.channels)
    in_logarithms = np.pad(logarithmic(model), (0, mean.shape[1] - channels))
    of_model = between + np.mean([v.variance for v in views], axis=0)

    def side(found: Array) -> tuple[Array, Array]:
        """The deviations at means [R, V]; what is not known of the model is a part of values whose noise is."""
        noise = np.pad(noise_at(each[0].run, found[:, :channels]) ** 2, ((0, 0), (0, mean.shape[1] - channels)))
        ratio = np.divide(found, mean, out=np.ones_like(mean), where=in_logarithms & (mean != 0))
        return found, np.sqrt(ratio**2 * of_model + noise)

    mean, sd = side(mean)
    apart = [np.where(side_of != v.variables, side_of, mean) for v in views for side_of in (v.low, v.high)]
    others = tuple(side(one) for one in apart if not np.array_equal(one, mean))
    states = np.mean([v.prediction.states for v in views], axis=0)
    first = views[0].prediction.start
    start = replace(first, state=np.mean([v.prediction.start.state for v in views], axis=0))
    estimated: tuple[str, ...] = ()
    if start.origin in ("estimated", "average"):
        free = each[0].estimator.free(item.at_rows(slice(rows)))
        estimated = (*(f"{model.states[i].name}({model.time.name}0)" for i in free),
                     *(model.constant_names[i] for i in each[0].estimator.own))  # fmt: skip
    used = uses(len(item.times), trained, 0 if position is not None or goes_on else rows)
    counted = np.pad(counted_channels(model), (0, mean.shape[1] - channels))
    outside = known.outside(model, item, states, first)
    labels = labels_of(each[0].evaluator.instance)
    alike = labels[position] if position is not None and start.origin == "learned" and labels else ""
    return PredictedTrajectory(item.label, item.times, mean, sd, item.values, used, outside, start, estimated,
                               in_logarithms, failure, each[0].run.fit.quantile, counted, others,
                               "" if alike == item.label else alike, each[0].run.fit.error_scales(model))  # fmt: skip
