"""Validation of a fitted run: on data, with other steps than in training, and against the truth if there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from gbspec.analysis.prediction import (
    ORIGINS,
    Prediction,
    extrapolated,
    mean_prediction,
    missed,
    predictions,
    said_of_defaults,
    said_of_groups,
    said_of_not_positive,
    said_of_restarts,
    said_of_starts,
)
from gbspec.analysis.systems import extrapolation_of
from gbspec.analysis.validation.data_sampling import sampling_like, starting
from gbspec.analysis.validation.limits import LimitsKept, limits_kept
from gbspec.analysis.validation.metrics import ChannelErrors, channel_errors, share_text
from gbspec.analysis.validation.step_check import StepCheck, step_check, warning_of_other_data
from gbspec.analysis.validation.truth_errors import TruthErrors, has_reference, truth_errors, without_truth
from gbspec.analysis.validation.worst import WorstRow, worst_row
from gbspec.arrays import Array
from gbspec.data import error_deviations, present_values, said_of_ranges, states_beyond
from gbspec.diagnostics import ComputationError, UserError
from gbspec.files import finite
from gbspec.frames import Tabled, counted, of_rows
from gbspec.ir import logarithmic, on_error_scales, said_of_scales
from gbspec.runs import encode

if TYPE_CHECKING:
    import polars as pl

    from gbspec.analysis.systems import Extrapolation
    from gbspec.backends import Evaluator
    from gbspec.data import Case, MetricsOptions, SimulateOptions, Trajectories
    from gbspec.ir import Model
    from gbspec.runs import Run, Support


FROM_STARTS = "solutions from the start alone, without the disturbances that lead the measured rows away from them"
"""What errors of whole solutions are where a model has random disturbances."""


@dataclass(frozen=True)
class TrajectoryError:
    """The NRMSE of one trajectory over all its measured values (each channel over its standard deviation in
    the whole data set; of logarithms, where the noise is log-normal).

    `initial` is the origin of its initial state; `failure` the reason why it could not be solved (`nrmse` is then NaN).
    `extrapolated` counts, for each unknown, the rows in which it is far from its training data; zeros are left out.
    """

    trajectory: str
    nrmse: float
    initial: str
    failure: str = ""
    extrapolated: Mapping[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """Keys trajectory, nrmse, initial, and failure if there is one."""
        document: dict[str, object] = {
            "trajectory": self.trajectory,
            "nrmse": finite(self.nrmse),
            "initial": self.initial,
        }
        if self.extrapolated:
            document["extrapolated"] = dict(self.extrapolated)
        return document | ({"failure": self.failure} if self.failure else {})


@dataclass(frozen=True, repr=False)
class Validation(Tabled):
    """The result of `gbspec validate`. `channels` are errors of autoregressive predictions from the initial states.

    Of a model with random disturbances `ahead` has the errors of predictions from the measurements so many rows before
    (`1`, `10`; `all`: from the initial states alone), by channel.

    Failed trajectories are named in `trajectories` and `warnings`, and excluded from all errors; `worst` is the
    measurement with the largest error, with random disturbances that of predictions one row ahead.
    """

    member: int | Literal["mean"]
    channels: Mapping[str, ChannelErrors]
    trajectories: tuple[TrajectoryError, ...]
    step_check: StepCheck
    truth: TruthErrors | None = None
    warnings: tuple[str, ...] = ()
    predictions: tuple[Prediction, ...] = field(default=(), repr=False)
    worst: WorstRow | None = None
    ahead: Mapping[str, Mapping[str, ChannelErrors]] = field(default_factory=dict)
    limits: Mapping[str, LimitsKept] = field(default_factory=dict)

    def to_frame(self) -> pl.DataFrame:
        """One row for each channel: `channel`, `n`, `rmse` and `mae` in the channel's unit, `nrmse` and `r2`; and
        `logarithms` or `counts`, where `nrmse` and `r2` of a channel are of these."""
        return of_rows({"channel": name, **errors.to_json()} for name, errors in self.channels.items())

    def summary(self) -> str:
        """Which prediction was compared with how many trajectories."""
        who = "mean of the members" if self.member == "mean" else f"member {self.member}"
        parts = ", ".join(
            f"R² {share_text(one.r2)} of {'the logarithms of ' if one.logarithms else ''}{name}"
            f"{' on the scale of its noise' if one.counts else ''}"
            for name, one in self.judged.items()
        )
        parts += " one row ahead" if parts and self.ahead else ""
        return f"{who}, {counted(len(self.trajectories), 'trajectory')}" + (f", {parts}" if parts else "")

    def notes(self) -> Sequence[str]:
        """The lines below the table: with random disturbances what it is, and the errors from row to row."""
        said = [f"the table above: {FROM_STARTS}", *self._rows_ahead()] if self.ahead else []
        return [*said, *self._rest()]

    @property
    def judged(self) -> Mapping[str, ChannelErrors]:
        """The errors by which a fit is judged: those of whole solutions, with random disturbances of one row ahead."""
        return self.ahead.get("1", self.channels)

    @property
    def failed(self) -> tuple[str, ...]:
        """The trajectories that could not be solved."""
        return tuple(item.trajectory for item in self.trajectories if item.failure)

    @property
    def empty(self) -> bool:
        """Whether there were measurements, but no trajectory could be solved, so that nothing was scored."""
        return bool(self.trajectories) and all(item.failure for item in self.trajectories)

    def warnings_after(self, known: Sequence[str]) -> list[str]:
        """The warnings of a fit (`fit.json`), then those of its validation that are not among them."""
        return [*known] + [warning for warning in self.warnings if not any(warning in one for one in known)]

    def to_json(self) -> dict[str, object]:
        """The document of `validate --json`."""
        document: dict[str, object] = {
            "channels": {name: errors.to_json() for name, errors in self.channels.items()},
            "trajectories": [item.to_json() for item in self.trajectories],
            "step_check": self.step_check.to_json(),
        }
        if self.truth is not None:
            document["truth"] = self.truth.to_json()
        if self.worst is not None:
            document["worst"] = encode(self.worst)
        if self.limits:
            document["limits"] = {name: one.to_json() for name, one in self.limits.items()}
        if self.ahead:
            document["ahead"] = {
                steps: {name: one.to_json() for name, one in found.items()} for steps, found in self.ahead.items()
            }
        return document | {"member": self.member, "warnings": list(self.warnings)}

    def __str__(self) -> str:
        # With disturbances, errors from row to row come first: a solution without them is no prediction of the model.
        lines = [*self._rows_ahead(), f"{FROM_STARTS}:"] if self.ahead else []
        if self.channels:
            wide = self._width
            shares, last = _right([share_text(e.r2) for e in self.channels.values()])
            lines.append(f"{'channel':<{wide}}{'n':>7}{'rmse':>12}{'nrmse':>12}{'mae':>12}{'r2':>{last}}")
            lines += [
                f"{name:<{wide}}{e.n:>7}{e.rmse:>12.4g}{e.nrmse:>12.4g}{e.mae:>12.4g}{share}"
                for (name, e), share in zip(self.channels.items(), shares, strict=True)
            ]
        return "\n".join([*lines, *self._rest()])

    @property
    def _width(self) -> int:
        """The width of the names of channels."""
        return max([16, *(len(name) + 2 for name in self.channels)])

    def _rows_ahead(self) -> list[str]:
        """The table of errors by the number of rows that predictions are ahead."""
        wide = self._width
        rows = [(steps, name, e) for steps, found in self.ahead.items() for name, e in found.items()]
        shares, last = _right([share_text(e.r2) for _, _, e in rows])
        return [
            f"{'rows ahead':<12}{'channel':<{wide}}{'n':>7}{'rmse':>12}{'r2':>{last}}",
            *(
                f"{steps:<12}{name:<{wide}}{e.n:>7}{e.rmse:>12.4g}{share}"
                for (steps, name, e), share in zip(rows, shares, strict=True)
            ),
        ]

    def _rest(self) -> list[str]:
        """The lines after the tables."""
        found = self.channels.items()
        logarithms, counts = [n for n, one in found if one.logarithms], [n for n, one in found if one.counts]
        lines = said_of_scales("nrmse and r2", logarithms, counts)
        lines += [f"{name}: {one}" for name, one in self.limits.items()]
        if self.worst is not None:
            lines.append(str(self.worst))
        longer = sum(item.initial == "continued" for item in self.trajectories)
        lines += [f"{counted(longer, 'trajectory')}: {ORIGINS['continued']}"] if longer else []
        check = self.step_check
        if check.half_step is not None and check.adaptive is not None:
            lines.append(f"step {check.step:.6g}: half step {check.half_step:.3g}, adaptive {check.adaptive:.3g}")
        elif check.ahead and check.half_step is not None:
            lines.append(f"step {check.step:.6g} of predictions from row to row: half step {check.half_step:.3g}")
        if self.truth is not None:
            lines.append(str(self.truth))
        return [*lines, *(f"warning: {warning}" for warning in self.warnings)]


def validate(
    run: Run,
    trajectories: Trajectories | None = None,
    *,
    member: int | Literal["mean"] = "mean",
    sampling: SimulateOptions | None = None,
    metrics: MetricsOptions | None = None,
    truth: bool = True,
) -> Validation:
    """Errors of a run on data (if given), the check of its step, and its errors against the truth.

    Predictions are solved by CVODES from each trajectory's initial state to its end without using later data: the
    initial state is the learned one on training data, and of trajectories that begin with the rows of one of these and
    go on; the known one if the first row or the model gives it, and else
    estimated from the trajectory itself. The zeros of absent states do not count, as in the training. The mean of the
    members is the mean of their predictions. `sampling` and `metrics` determine the comparison with the truth; default:
    the model's case if it is bundled, else as in the data (`data_sampling`), and general values without data.

    Raises UserError if there is no such member.
    """
    from gbspec.backends import Evaluator

    members = run.members if member == "mean" else (run.member(member),)
    evaluators = [Evaluator(one) for one in members]
    warnings: list[str] = []
    predicted: tuple[Prediction, ...] = ()
    channels: dict[str, ChannelErrors] = {}
    errors: tuple[TrajectoryError, ...] = ()
    worst: WorstRow | None = None
    step = run.equal_step(run.numbers[0] if member == "mean" else member)
    check = StepCheck(None, None, step)
    if trajectories is not None:
        each = [predictions(one, run.model, trajectories, run.fit) for one in evaluators]
        predicted = tuple(mean_prediction(group) for group in zip(*each, strict=True))
        known = extrapolation_of(run, None if member == "mean" else member)
        present = present_values(run.model, trajectories)
        channels, errors = _on_data(run, present, predicted, known)
        worst = worst_row(run, present, predicted)
        # Each right-hand side has its own dependence on the step, so for a mean of several its first member is checked.
        # With disturbances the step is the filter's, which does not solve from the start.
        if not run.model.diffusions:
            check = step_check(evaluators[0], run.model, step, trajectories.items, each[0])
        warnings += [*said_of_defaults(run, trajectories.items), *said_of_restarts(run, trajectories)]
        warnings += _without_logarithm(run.model, present, predicted)
        warnings += _data_warnings(errors, run.model)
        warnings += [] if run.model.diffusions else _of_starts(run, present, predicted)
        warnings += said_of_groups(members[0], run.model, trajectories.items, predicted)
        solved = [one.states for one in predicted if not one.failure]
        warnings += said_of_ranges(states_beyond(run.model, np.concatenate(solved))) if solved else []
    place = 0 if member == "mean" else run.numbers.index(member)
    said = warning_of_other_data(check, run.fit.step_checks[place] if place < len(run.fit.step_checks) else None)
    warnings += [said] if said else []
    kept = {} if trajectories is None else limits_kept(run.model, trajectories, predicted)
    compared = None
    if truth and has_reference(run.model):
        support = run.certainties(run.numbers[0] if member == "mean" else member).support
        compared = _against_truth(run.model, evaluators, trajectories, sampling, metrics, warnings, support)
    return Validation(member, channels, errors, check, compared, tuple(warnings), predicted, worst,
                      limits=kept)  # fmt: skip


def _right(shares: Sequence[str]) -> tuple[list[str], int]:
    """The texts of a last column, to its right, and its width: two blanks at least before each."""
    wide = max([10, *(len(share) + 2 for share in shares)])
    return [f"{share:>{wide}}" for share in shares], wide


def _stacked(trajectories: Trajectories) -> Array:
    return np.concatenate([item.values for item in trajectories.items])


def _on_data(
    run: Run, trajectories: Trajectories, predictions: Sequence[Prediction], known: Extrapolation | None
) -> tuple[dict[str, ChannelErrors], tuple[TrajectoryError, ...]]:
    measured, model = _stacked(trajectories), run.model
    predicted = np.concatenate(
        [one.channels if not one.failure else np.full(one.channels.shape, np.nan) for one in predictions]
    )
    number, scales = np.concatenate([item.counts for item in trajectories.items]), run.fit.error_scales(model)
    deviation = error_deviations(trajectories, scales)
    channels = {
        channel.name: channel_errors(measured[:, j], predicted[:, j], scales[j], number[:, j])
        for j, channel in enumerate(model.channels)
    }
    errors = []
    for item, one in zip(trajectories.items, predictions, strict=True):
        values, found = on_error_scales(scales, item.values, one.channels, item.counts)
        relative = ((found - values) / deviation)[np.isfinite(values) & np.isfinite(found)]
        nrmse = float(np.sqrt(np.mean(relative**2))) if relative.size and not one.failure else float("nan")
        far = {} if one.failure else extrapolated(known, model, item, one.states, one.start)
        counts = {name: int(rows.sum()) for name, rows in far.items() if rows.any()}
        errors.append(TrajectoryError(item.label, nrmse, one.start.origin, one.failure, counts))
    return channels, tuple(errors)


def _without_logarithm(model: Model, trajectories: Trajectories, predictions: Sequence[Prediction]) -> list[str]:
    """A warning of each channel with log-normal noise of which measured rows have predictions of zero or less."""
    log, solved = logarithmic(model), []
    effect = f"nrmse and R² of {FROM_STARTS}, " if model.diffusions else "nrmse, R² and the worst row "
    for item, one in zip(trajectories.items, predictions, strict=True):
        if not one.failure:
            solved.append(np.where(item.values > 0, one.channels, np.nan))
    stacked = np.concatenate(solved) if solved else np.zeros((0, len(log)))
    return [
        said
        for j in np.flatnonzero(log)
        for said in said_of_not_positive(
            model, int(j), stacked[:, j], int(np.isfinite(stacked[:, j]).sum()), f"{effect}leave them out"
        )
    ]


def _data_warnings(errors: Sequence[TrajectoryError], model: Model) -> list[str]:
    warnings = [
        f"trajectory `{one.trajectory}` could not be solved and is excluded from all errors: {one.failure}"
        for one in errors
        if one.failure
    ]
    far = [one for one in errors if one.extrapolated]
    if far:
        listed = ", ".join(f"`{one.trajectory}`" for one in far[:5]) + (", ..." if len(far) > 5 else "")
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(name for one in far for name in one.extrapolated))
        rows = counted(sum(max(one.extrapolated.values()) for one in far), "row")
        each = "is extrapolated, far from its" if ", " not in names else "are extrapolated, far from their"
        warnings.append(f"{names} {each} training data, in {rows} ({listed})")
    estimated = [one.trajectory for one in errors if one.initial == "estimated"]
    if estimated:
        listed = ", ".join(f"`{label}`" for label in estimated[:5]) + (", ..." if len(estimated) > 5 else "")
        number = counted(len(estimated), "trajectory")
        own = any(k.per_trajectory for k in model.learnables)
        what, which, rest = "own constants and unknown initial states" if own else "initial states", "the errors", ""
        if model.diffusions and not own and not any(state.initial.kind == "learned" for state in model.states):
            which = "the errors of solutions from the start alone, and those `all` rows ahead,"
            rest = "; those 1 and 10 rows ahead have a first guess of the start from these, which counts in early rows"
        warnings.append(
            f"the {what} of {number} that training did not see ({listed}) were estimated from the same "
            f"measurements that {which} are computed from{rest}"
        )
    return warnings


def _of_starts(run: Run, trajectories: Trajectories, predicted: Sequence[Prediction]) -> list[str]:
    """A warning of estimated starts whose solutions do not follow the trajectories that they were estimated from."""
    scales = run.fit.scales_for(run.model, trajectories)
    found = [
        missed(run.model, run.fit, scales, item, one.channels)
        for item, one in zip(trajectories.items, predicted, strict=True)
        if one.start.origin == "estimated" and not one.failure
    ]
    return said_of_starts(found, _REMEDY)


_REMEDY = (
    "A start that is known can be given by the first row of the table or by `initial` in the model, and "
    "`gbspec predict --window` estimates it from fewer rows"
)


def _against_truth(
    model: Model,
    evaluators: Sequence[Evaluator],
    data: Trajectories | None,
    sampling: SimulateOptions | None,
    metrics: MetricsOptions | None,
    warnings: list[str],
    support: Mapping[str, Support],
) -> TruthErrors | None:
    """The errors against the truth; None, and a warning, if the comparison cannot be made."""
    from gbspec.data import MetricsOptions as Metrics

    lacking = without_truth(model)
    if lacking:
        names = ", ".join(f"`{name}`" for name in lacking)
        warnings.append(f"there is no `truth` of {names}: in the reference stands the starting value")
    case = bundled_case(model)
    if sampling is None:
        sampling = case.sampling if case is not None else sampling_like(model, data)
        model = model if case is not None else starting(model, data)
    if metrics is None:
        metrics = case.metrics if case is not None else _few() if model.delays else Metrics()
    try:
        found = truth_errors(model, evaluators, sampling, metrics, support)
    except UserError as error:
        warnings.append(
            "the model was not compared with its truth, since the points are not determined: "
            + "; ".join(diagnostic.message for diagnostic in error.diagnostics)
        )
        return None
    except ComputationError as error:
        warnings.append(f"the model was not compared with its truth: {error.what}")
        return None
    for name, norm in {"solution": found.solution, "right-hand side": found.rhs, **found.functions}.items():
        if norm.failed:
            points = counted(norm.failed, "point could not be computed and is", "points could not be computed and are")
            warnings.append(f"{name}: {points} excluded from the error")
    return found


def _few() -> MetricsOptions:
    """Points of a comparison of models with delays, whose solutions take a hundred times as long as those of others."""
    from gbspec.data import MetricsOptions as Metrics

    return Metrics(conditions=8, points=5, rhs_points=80)


def bundled_case(model: Model) -> Case | None:
    """The case of the bundled model of this name, if its sampling fits this model's states and conditions."""
    from gbspec.data import find_cases, shipped_models

    path = shipped_models().get(model.name)
    if path is None:
        return None
    case = find_cases(path).of_model(model.name)
    states = {state.name for state in model.states}
    external = {item.name for item in (*model.conditions, *model.inputs)}
    fits = set(case.sampling.initial) <= states and set(case.sampling.condition) <= external
    return replace(case) if fits else None
