"""Training: a fit, a sweep of fits, the check of integration steps, and the profile of a constant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import Diagnostic, UserError, packages
from gbspec.frames import counted

if TYPE_CHECKING:
    from gbspec.data import Trajectories
    from gbspec.ir import Model
    from gbspec.runs import Run
    from gbspec.training import Point, Profile, Progress, Row, TrainOptions


@packages()
def train(
    model: Model, data: Trajectories, directory: Path, options: TrainOptions, progress: Progress | None = None
) -> Run:
    """Fits the learnables and unknowns of a model to data into a run directory, then checks every fit's step."""
    from gbspec.training import writing

    with writing(directory, options.resume):
        return with_step_checks(fit(model, data, directory, options, progress), data, options)


@packages()
def fit(
    model: Model, data: Trajectories, directory: Path, options: TrainOptions, progress: Progress | None = None
) -> Run:
    """Like `train` but without the check of steps, for studies, which have their own checks."""
    if progress is not None:  # before torch is imported, which takes seconds
        size = f"{counted(data.measurements, 'value')} in {counted(len(data), 'trajectory')}"
        progress.message(f"preparing: {model.name}, {size}{_absent(model, data)}")
    from gbspec.training import train as run

    return run(model, data, options, directory, progress)


def _absent(model: Model, data: Trajectories) -> str:
    """What is said of states that are absent from trajectories."""
    from gbspec.data import absent_states

    absent = absent_states(model, data.items)
    found = [
        f"`{state.name}` from {column.sum()}"
        for state, column in zip(model.states, absent.T, strict=True)
        if column.any()
    ]
    return f"; absent, so that their zeros do not count: {', '.join(found)} of these" if found else ""


@packages()
def with_step_checks(run: Run, data: Trajectories, options: TrainOptions) -> Run:
    """The run fitted to `data`, with the check of each member's step and, before all others, warnings for those that
    depend on it."""
    from gbspec.analysis import check_fit
    from gbspec.operations.filtering import check_steps
    from gbspec.training import split

    if len(data) == 1:  # of a single trajectory the last rows were held out; the others were trained on
        data, _ = split(data, options.holdout, options.seed)
    if run.model.diffusions:
        checks = tuple(check_steps(run, data, number) for number in run.numbers)
    else:
        checks = check_fit(run, data)
    warnings = [f"member {k}: {check.warning}" for k, check in zip(run.numbers, checks, strict=True) if check.warning]
    records = tuple(check.record() for check in checks)
    return run.amended(replace(run.fit, step_checks=records, warnings=(*warnings, *run.fit.warnings)))


@packages()
def sweep(
    model: Model,
    data: Trajectories,
    points: Sequence[Point],
    directory: Path,
    options: TrainOptions,
    progress: Progress | None = None,
) -> list[Row]:
    """Trains with each point's options into a separate run directory; returns a row of results for each.

    A row's columns are those of `sweep.csv`; each varied option has a column with its name.
    """
    from gbspec.runs import member_numbers, open_run
    from gbspec.training import sweep as run

    rows = run(model, data, points, options, directory, progress)
    for point in points:
        if member_numbers(directory / point.name):
            made = open_run(directory / point.name)
            checked = with_step_checks(made, data, point.options)
            for warning in checked.fit.warnings[: len(checked.fit.warnings) - len(made.fit.warnings)]:
                if progress is not None:
                    progress.message(f"{point.name}: {warning}")
    return rows


@packages()
def profile(
    run: Run,
    name: str,
    data: Trajectories,
    *,
    member: int | None = None,
    points: int = 6,
    iterations: int = 60,
    progress: Callable[[float, float], None] | None = None,
) -> Profile:
    """The profile likelihood of a learned constant."""
    from gbspec.training import profile_constant

    if run.model.diffusions:
        raise UserError([without_disturbances("profile")])

    return profile_constant(run, name, data, member=member, points=points, iterations=iterations, progress=progress)


def without_disturbances(command: str) -> Diagnostic:
    """The diagnostic (GB772) of a command that does not know random disturbances."""
    message = f"`gbspec {command}` is not offered for a model with `diffusion`, whose likelihood is that of innovations"
    help = (
        "`gbspec report` and `fit.json` have the standard deviations and intervals of its constants; `gbspec compare` "
        "tests it against a fit with one of them at a value (`const`)"
    )
    return Diagnostic("GB772", message, None, help=help)
