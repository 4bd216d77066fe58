"""Results of the filter of a run whose model has random disturbances: errors ahead, smoothed states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gbspec.analysis import ChannelErrors, Forecast, PredictedTrajectory, StepCheck, Use, WorstRow
    from gbspec.arrays import Mask
    from gbspec.data import Trajectories
    from gbspec.runs import Run
    from gbspec.training import FilteredRun

STEPS: Mapping[str, int | None] = {"1": 1, "10": 10, "all": None}
"""How many rows ahead predictions are compared with the measurements."""

LACKING = (
    "the intervals contain the disturbances and the noise, but not what the fit leaves open of constants and "
    "functions: they are too narrow, the more so the further a row is from the last measured one"
)
"""What is said of predictions where the covariance is not known, as with unknown functions."""


def errors_ahead(
    run: Run, data: Trajectories, filtered: FilteredRun
) -> tuple[dict[str, dict[str, ChannelErrors]], WorstRow | None, list[str]]:
    """The errors of predictions by the number of rows that they are ahead, and by channel, the worst row of those one
    row ahead, and what is said of single rows that have most of these errors; of the filter of one member."""
    from gbspec.analysis import channel_errors, said_of_single_rows, worst_ahead

    if not filtered.finite:
        return {}, None, []
    measured = np.concatenate([item.values[item.times >= item.start] for item in data.items])
    out, said, scales = {}, list[str](), run.fit.error_scales(run.model)
    spreads = [one.channel_sd for one in filtered.one_ahead()]
    for name, steps in STEPS.items():
        each = filtered.ahead(steps)
        found = np.concatenate(each)
        out[name] = {
            c.name: channel_errors(measured[:, j], found[:, j], scales[j]) for j, c in enumerate(run.model.channels)
        }
        said += said_of_single_rows(run, data, name, each, spreads if steps == 1 else None)
    return out, worst_ahead(run, data, 1, list(zip(filtered.ahead(1), spreads, strict=True))), said


def check_steps(run: Run, data: Trajectories, member: int, filtered: FilteredRun | None = None) -> StepCheck:
    """Whether the predictions of a member's filter (`filtered`, if it has been run) depend on the steps that it takes
    from row to row. There is nothing to check where they are exact, or follow a tolerance."""
    from gbspec.analysis import StepCheck, filter_check
    from gbspec.training import filter_run, without_steps

    if without_steps(run.model) or run.tolerance(member) is not None:
        return StepCheck(None, None)
    coarse = filtered or filter_run(run, data, member)
    step = coarse.longest_step
    if not step:
        return StepCheck(None, None)
    fine = filter_run(run, data, member, max_step=step / 2)
    return filter_check(step, [item.label for item in data.items], coarse.states_ahead(), fine.states_ahead())


def smoothed_forecast(run: Run, data: Trajectories, window: int | None) -> Forecast:
    """Channels and states at all rows of a table, with bands, as the measurements of the first `window` rows (all of
    them without it) show them; of the best member. Bands contain what the fit leaves open of the constants."""
    from gbspec.analysis import (
        Forecast,
        PredictedTrajectory,
        Start,
        Trained,
        said_of_coverage,
    )
    from gbspec.data import continued
    from gbspec.training import filter_run

    filtered = filter_run(run, data, run.best, window)
    model, ranges, scales = run.model, Trained.of(run), run.fit.error_scales(run.model)
    known = continued(run.member(run.best).info.get("beginnings"), data.items)
    items: list[PredictedTrajectory] = []
    hidden = [i for i in range(len(model.states)) if all(c.state != i for c in model.channels)]
    covariance = run.certainties(run.best).covariance
    each = filtered.smoothed_after(None if covariance is None else covariance.without(run.values))
    for item, longer, one, constants in zip(data.items, known, each, filtered.constants, strict=True):
        rows = item.times >= item.start
        log = np.concatenate([one.log_channels, one.log[hidden]])
        mean = np.concatenate([one.channels, one.states[:, hidden]], axis=1)
        sd = np.concatenate([one.channel_sd, one.state_sd[:, hidden]], axis=1)
        values = np.concatenate([item.values[rows], np.full((len(mean), len(hidden)), np.nan)], axis=1)
        trained = 0 if longer is None else int(np.count_nonzero(rows[: longer[1]]))
        used = _uses(np.isfinite(item.values[rows]), window, trained)
        first = one.states[0] if len(one.states) else np.full(len(model.states), np.nan)
        start = Start(first, constants, "smoothed" if window is None else "estimated")
        lost = ~np.isfinite(mean).all(axis=1)
        items.append(
            PredictedTrajectory(
                item.label,
                item.times[rows],
                mean,
                np.where(log, sd * np.abs(mean), sd),
                values,
                used,
                ranges.outside(model, replace(item, times=item.times[rows]), one.states, start),
                start,
                filtered.estimated,
                log,
                f"the moments of the filter are not finite from {item.times[rows][lost][0]:g} on" if lost.any() else "",
                scales=scales,
            )
        )
    channels, states = tuple(c.name for c in model.channels), tuple(s.name for s in model.states)
    names = (*channels, *(states[i] for i in hidden))
    lacking = LACKING if covariance is None else ""
    found = Forecast(
        names, channels, states, tuple(items), 1, _said(run, data, items, hidden, lacking), model.time.name
    )
    return replace(found, warnings=(*found.warnings, *said_of_coverage(found.errors())))


def _said(
    run: Run, data: Trajectories, items: Sequence[PredictedTrajectory], hidden: Sequence[int], lacking: str
) -> tuple[str, ...]:
    """The warnings of predicted trajectories; `lacking`: what bands of rows that were not used lack."""
    from gbspec.analysis import said_of_defaults, said_of_ends, said_of_items, said_of_restarts, said_of_states
    from gbspec.runs import said_of_training

    ahead = any("predicted" in item.used for item in items)
    return (
        *said_of_defaults(run, data.items),
        *said_of_restarts(run, data),
        *said_of_items(items, lacking if ahead else ""),
        *said_of_ends(run.model, items, hidden),
        *said_of_states(run.model, items, tuple(hidden)),
        *(said_of_training(run.fit.members) if ahead else ()),
    )


def _uses(measured: Mask, window: int | None, trained: int) -> tuple[Use, ...]:
    """The use of each row of a trajectory with these `measured` values [R, C], of which the first `trained` rows are
    rows of the training data. Rows after the last one that was measured are of no window."""
    some = measured.any(axis=1).astype(int)
    before, after = np.cumsum(some) - some, np.cumsum(some[::-1])[::-1]
    return tuple(
        "window" if (window is None or count < window) and later else "training" if row < trained else "predicted"
        for row, (count, later) in enumerate(zip(before.tolist(), after.tolist(), strict=True))
    )
