"""Analyses of a model at its truth or of a run: eigenvalues, bifurcations, predictions, errors."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gbspec.diagnostics import Diagnostic, UserError, packages
from gbspec.given import is_whole, shown
from gbspec.ir import not_categories
from gbspec.operations.models import Subject, truth_of
from gbspec.operations.totals import require_isolated

if TYPE_CHECKING:
    import polars as pl

    from gbspec.analysis import (
        Box,
        Diagram,
        Eigen,
        Forecast,
        InitialStates,
        PlaneDiagram,
        Prediction,
        System,
        Validation,
    )
    from gbspec.arrays import Array
    from gbspec.data import Trajectories
    from gbspec.runs import Run


@packages()
def system(source: Subject) -> System:
    """A subject as a dynamical system to analyse."""
    from gbspec.analysis import extrapolation_of, system_of

    extrapolation = None if source.run is None else extrapolation_of(source.run)
    return system_of(source.evaluator, source.model, extrapolation)


@packages()
def eigen(
    source: Subject,
    *,
    at: Mapping[str, float] | Sequence[Mapping[str, float]] = (),
    along: Trajectories | None = None,
    steady: bool = False,
) -> Eigen:
    """Eigenvalues of a subject at one point or several; for a run also those of its model's truth, if there is one.

    Raises UserError (GB383) for a point with a number of no category, and (GB877) for steady states of balances that
    conserve something.
    """
    from gbspec.analysis import eigen as run

    _without_events(source, "eigen")
    points = [at] if isinstance(at, Mapping) else at
    if steady:
        moved = {name for point in points for name in point}
        require_isolated(source.model, _held(system(source), moved))
    wrong = [problem for point in points for problem in not_categories(source.model.conditions, _each(point))]
    if wrong:
        raise UserError(wrong)
    true = truth_of(source)
    truth = None if true is None else system(true)
    predicted: list[Prediction] = []
    if along is not None:
        from gbspec.analysis import predictions

        fit = None if source.run is None else source.run.fit
        predicted = predictions(source.evaluator, source.model, along, fit)
    return run(system(source), truth=truth, at=points, along=along, predicted=predicted, steady=steady)


def _each(point: Mapping[str, float]) -> dict[str, tuple[float]]:
    return {name: (value,) for name, value in point.items()}


def _varied(source: Subject, *names: str) -> None:
    """Raises UserError (GB383) for a parameter that has categories, between which there is nothing."""
    for condition in source.model.conditions:
        if condition.name in names and condition.categories:
            message = f"`{condition.name}` cannot be varied: it is one of some categories"
            help = f"vary another parameter, for each category in turn: `--set {condition.name}=0`"
            raise UserError([Diagnostic("GB383", message, None, help=help)])


def _isolated(source: Subject, subject: System, varied: Mapping[str, Box]) -> None:
    """Raises UserError (GB877) for balances that conserve something, after what is wrong with a range (GB875); a name
    that cannot be varied is left to the analysis."""
    from gbspec.analysis import require_range

    for name, box in varied.items():
        require_range(name, *box)
    if all(name in subject.parameters for name in varied):
        require_isolated(source.model, _held(subject, varied))


def _held(subject: System, varied: Collection[str]) -> dict[str, float]:
    """The values of all that is not varied."""
    return {name: value for name, value in subject.values.items() if name not in varied}


def _without_events(source: Subject, command: str) -> None:
    """Raises UserError (GB778) for a model with events, which has no steady states in the sense of these analyses."""
    if source.model.events:
        message = f"`gbspec {command}` is not for a model with events: it analyses equations that do not switch"
        help = "simulate it, or analyse a model without the events, each discrete value a `const`"
        raise UserError([Diagnostic("GB778", message, None, help=help)])


@packages()
def initial_states(source: Subject, data: Trajectories, indices: Sequence[int] | None = None) -> InitialStates:
    """Learned, bred and true initial states of a run's trajectories, side by side."""
    from gbspec.analysis import initial_states as run

    true = truth_of(source)
    known = None if source.run is None else source.run.fit.data
    truth = None if true is None else true.evaluator
    return run(source.evaluator, source.model, data, known, system(source), truth, indices)


@packages()
def learned_starts(source: Subject, data: Trajectories) -> pl.DataFrame:
    """The initial states of a run's trajectories and their own constants, by the labels of the table."""
    from gbspec.analysis import learned_positions, learned_start
    from gbspec.frames import of_rows

    evaluator, model = source.evaluator, source.model
    known = None if source.run is None else source.run.fit.data
    own = [i for i, name in enumerate(model.constant_names) if name in evaluator.instance.per_trajectory]
    rows = []
    for item, position in zip(data.items, learned_positions(evaluator.instance, data, known), strict=True):
        if position is None:
            continue
        start = learned_start(evaluator, position, item)
        states = {state.name: float(value) for state, value in zip(model.states, start.state, strict=True)}
        constants = {model.constant_names[i]: float(start.constants[i]) for i in own}
        rows.append({"trajectory": item.label, "time": float(item.start), **states, **constants})
    return of_rows(rows)


@packages()
def bifurcate(
    source: Subject, over: str, low: float, high: float, *, cycles: bool = True, doublings: int = 1
) -> Diagram:
    """The bifurcation diagram of a subject over one parameter, with at most `doublings` period doublings followed; for
    a run with the uncertainty of folds and Hopf points, if its covariance is known and its constants have intervals.

    Without these the data are exact for all the fit can tell: what is wrong is then the approximation, of which a
    covariance says nothing. Raises UserError (GB877) for balances that conserve something.
    """
    from gbspec.analysis import BifurcationOptions, Certainty, CycleOptions, with_uncertainty
    from gbspec.analysis import bifurcate as run
    from gbspec.report import units

    _without_events(source, "bifurcate")
    _varied(source, over)
    subject = system(source)
    _isolated(source, subject, {over: (low, high)})
    options = BifurcationOptions(cycles=cycles, cycle=CycleOptions(doublings=doublings))
    found = replace(run(subject, over, low, high, options), units=units(source.model))
    if source.run is None or source.member is None:
        return found
    covariance = source.run.certainties(source.member).covariance
    if source.model.delays:  # roots of equations with delays are not differentiated by what was learned
        return found
    shared = [record for record in source.run.fit.constants.values() if record.per_trajectory is None]
    if covariance is None or (shared and all(record.interval is None for record in shared)):
        return found
    return with_uncertainty(found, subject, Certainty(source.evaluator.instance, covariance, tuple(source.values)))


def true_diagram(
    source: Subject, over: str, low: float, high: float, *, cycles: bool = True, doublings: int = 1
) -> Diagram | None:
    """The same for the truth of a run's model; None if there is none."""
    truth = truth_of(source)
    return None if truth is None else bifurcate(truth, over, low, high, cycles=cycles, doublings=doublings)


def joined(diagrams: Sequence[Diagram]) -> Diagram:
    """The diagram of the first member, its special points with intervals over all members."""
    from gbspec.analysis import with_intervals

    return with_intervals(diagrams) if len(diagrams) > 1 else diagrams[0]


@packages()
def bifurcation_plane(source: Subject, names: tuple[str, str], boxes: tuple[Box, Box]) -> PlaneDiagram:
    """The Hopf and fold curves of a subject in a box of the plane of two of its parameters.

    Raises UserError (GB877) for balances that conserve something.
    """
    from gbspec.analysis import bifurcation_plane as run

    _without_events(source, "bifurcate")
    _varied(source, *names)
    subject = system(source)
    if subject.delayed is not None:
        message = "the plane of two parameters is not offered for a model with delayed states"
        help = "give one parameter: its steady states, their roots and Hopf points are computed"
        raise UserError([Diagnostic("GB769", message, None, help=help)])
    _isolated(source, subject, dict(zip(names, boxes, strict=True)))
    return run(subject, names, boxes)


def true_plane(source: Subject, names: tuple[str, str], boxes: tuple[Box, Box]) -> PlaneDiagram | None:
    """The same for the truth of a run's model; None if there is none."""
    truth = truth_of(source)
    return None if truth is None else bifurcation_plane(truth, names, boxes)


@packages()
def validate(run: Run, data: Trajectories | None, member: int | Literal["mean"] = "mean") -> Validation:
    """Errors of a run on data, at half its step, by an adaptive solver, and against the truth; with disturbances also
    of the filter's predictions from row to row, of which the step is checked."""
    from gbspec.analysis import validate as check

    found = check(run, data, member=member)
    if not run.model.diffusions or data is None:
        return found
    from gbspec.operations.filtering import check_steps, errors_ahead
    from gbspec.training import filter_run

    one = run.best if member == "mean" else member
    filtered = filter_run(run, data, one)
    (ahead, worst, single), steps = errors_ahead(run, data, filtered), check_steps(run, data, one, filtered)
    said = (*single, *((steps.warning,) if steps.warning else ()))
    return replace(found, ahead=ahead, worst=worst or found.worst, step_check=steps, warnings=(*found.warnings, *said))


@packages()
def predict(run: Run, data: Trajectories, *, window: int | None = None, path: str | Path | None = None) -> Forecast:
    """Predictions of a run for a table, from the first `window` measured rows; also written to `path`, if given.

    Raises `UserError` (GB814) for a window that is no whole number of at least 1.
    """
    if window is not None and not (is_whole(window) and window >= 1):
        raise UserError(
            [Diagnostic("GB814", f"the window is {shown(window)}, and must be a whole number, at least 1", None)]
        )
    from gbspec.analysis import forecast
    from gbspec.report import write

    if run.model.diffusions:
        from gbspec.operations.filtering import smoothed_forecast

        found = smoothed_forecast(run, data, window)
    else:
        found = forecast(run, data, window=window)
    if path is not None:
        write(path, found)
    return found


@packages()
def function_frame(run: Run, name: str, points: object) -> pl.DataFrame:
    """A learned function and its 90 % band at points: a table with a column for each argument, or numbers [P, A].

    Raises ValueError if there is no such function, if an argument has no column, or if the numbers have another shape.
    """
    import numpy as np
    import polars as pl

    from gbspec.analysis import function_bands
    from gbspec.data import frame_columns, is_frame

    networks = {output: network for network in run.model.networks for output in network.outputs}
    if name not in networks:
        raise ValueError(f"there is no function `{name}`; there are {', '.join(networks) or 'none'}")
    arguments = [argument.name for argument in networks[name].arguments]
    columns = frame_columns(points) if is_frame(points) else _columns(name, arguments, points)
    lacking = [argument for argument in arguments if argument not in columns]
    if lacking:
        raise ValueError(
            f"`{name}` is a function of {', '.join(arguments)}: no column of numbers is named {', '.join(lacking)}"
        )
    at = np.stack([columns[argument] for argument in arguments], axis=-1)
    value, low, high = function_bands(run, name, at)
    found = {**{argument: columns[argument] for argument in arguments}, "value": value, "low": low, "high": high}
    return pl.DataFrame(found, nan_to_null=True)


def _columns(name: str, arguments: Sequence[str], points: object) -> dict[str, Array]:
    """The columns of points [P, A] by argument; points [P] for a single one. Raises ValueError."""
    import numpy as np

    wanted = f"a table with columns {', '.join(arguments)}, or numbers [points, {len(arguments)}]"
    try:
        at = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"the points of `{name}` are {wanted}") from None
    if at.ndim == 1 and len(arguments) == 1:
        at = at[:, None]
    if at.ndim != 2 or at.shape[1] != len(arguments):
        raise ValueError(f"the points of `{name}` are {wanted}, not {list(at.shape)}")
    return dict(zip(arguments, at.T, strict=True))
