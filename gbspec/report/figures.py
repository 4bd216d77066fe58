"""The figures of a run by their kind; what a kind needs and does not find becomes a diagnostic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from gbspec.arrays import Array
from gbspec.data.statistics import channel_scales
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.report import collect, plots, unknowns
from gbspec.report.collect import spaced
from gbspec.report.initial_states import initial_states as draw_starts
from gbspec.runs.store import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("fit", "functions", "constants", "history", "residuals", "phase", "initial-states", "summary")
"""What can be drawn."""
ALIASES = {"function": "functions", "constant": "constants", "residual": "residuals"}
MOST_STARTS = 40
"""Trajectories whose initial states are compared where the caller names none."""
SHOWN = 4
"""Trajectories in a figure where the caller names none."""


def draw(kind: str, run: Run, data: Trajectories | None, show: Sequence[str] = ()) -> Figure:
    """The figure of that kind; `show` names trajectories by label (default: the first four).

    Raises `UserError` (GB813) where the run, the model or the data lack what the figure shows.
    """
    kind = ALIASES.get(kind, kind)
    match kind:
        case "constants":
            found = collect.constants(run)
            return plots.constants(found) if found else _refuse(kind, "the model has no learned constant", "functions")
        case "history":
            members = collect.history(run)
            return plots.history(members) if members else _refuse(kind, "the run has no `history.csv`", "fit")
    if data is None or not len(data):
        _refuse(kind, "the table that the run was trained on is not where it was; name one with `--data`", "constants")
    fitted = collect.Fitted(run, data)
    indices = _chosen(data, show)
    match kind:
        case "functions":
            if not run.model.unknowns:
                _refuse(kind, "every function of the model is known", "constants")
            return plots.functions(unknowns.learned_functions(fitted))
        case "residuals":
            return plots.residuals(collect.residuals(fitted))
        case "phase":
            if len(run.model.states) < 2:
                _refuse(kind, "the model has only one state", "fit")
            first, second = run.model.states[:2]
            return plots.phase(collect.orbits(fitted, indices, (0, 1)), first.name, second.name)
        case "initial-states":
            shown = indices if show else spaced(len(data), MOST_STARTS)
            return draw_starts(collect.initial_states(fitted, shown))
        case "summary":
            return summary(fitted, indices[0] if show else liveliest(data))
        case _:
            return plots.fit(collect.trajectory_fits(fitted, indices), run.model.time.name)


def summary(fitted: collect.Fitted, index: int) -> Figure:
    """One picture of a run: a trajectory, the first unknown and the constants."""
    (shown,) = collect.trajectory_fits(fitted, [index])
    functions = unknowns.learned_functions(fitted)
    time = fitted.model.time.name
    return plots.summary(shown, functions[0] if functions else None, collect.constants(fitted.run), time)


def liveliest(data: Trajectories) -> int:
    """The trajectory whose channels change most from row to row: the one from which most can be seen."""

    def change(values: Array) -> float:
        return float(sum(np.abs(np.diff(column[np.isfinite(column)])).sum() for column in values.T))

    spreads = channel_scales(data)
    return int(np.argmax([change(item.values / np.where(spreads > 0, spreads, 1.0)) for item in data.items]))


def _chosen(data: Trajectories, show: Sequence[str]) -> list[int]:
    labels = [item.label for item in data.items]
    missing = [label for label in show if label not in labels]
    if missing:
        named = ", ".join(f"`{label}`" for label in missing)
        help = f"the first ones are {', '.join(labels[:8])}"
        raise UserError([Diagnostic("GB813", f"the table has no trajectory {named}", None, help=help)])
    return [labels.index(label) for label in show] if show else list(range(min(SHOWN, len(labels))))


def _refuse(kind: str, why: str, instead: str) -> NoReturn:
    message = f"the figure `{kind}` cannot be drawn: {why}"
    raise UserError([Diagnostic("GB813", message, None, help=f"`{instead}` can be drawn instead")])
