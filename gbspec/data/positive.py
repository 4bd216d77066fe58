"""Values of channels with log-normal noise: above zero, except the zeros of states that are absent from a trajectory.

A trajectory in which all values of such a channel are 0 is judged when the trajectories are complete, since doses,
starts and balances decide whether its state is absent; all other zeros are reported with the other errors of the table.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Mask
from gbspec.data.columns import Quantity
from gbspec.data.records import Records, Series
from gbspec.data.sheet import shown
from gbspec.data.trajectories import Trajectory
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import Model

_UNDETECTED = (
    "where nothing was detected, write `<` and the limit of detection (`<0.05`: a censored value), and leave the cell "
    "empty where nothing was measured"
)


def check_positive(table: Records, quantity: Quantity, cells: Series, findings: Findings) -> None:
    """Reports values that are not above zero (GB724), except those of trajectories with nothing but zeros."""
    bad = np.flatnonzero((cells.value <= 0) & ~_nothing_else(table, cells))
    advice = f"{_UNDETECTED}; `noise normal(…)` accepts zeros and negative values"
    if not (cells.value[bad] < 0).any():
        advice = (
            f"{_UNDETECTED}, or what is known to be zero, as before a dose; the zeros of a state that is absent from a "
            "trajectory (0 in each of its rows) do not count; `noise normal(…)` accepts all zeros"
        )
    _report(table, quantity, cells, bad, advice, findings)


def check_zeros(table: Records, model: Model, items: Sequence[Trajectory], findings: Findings) -> None:
    """Reports the zeros of whole trajectories (GB724) whose state is not absent, with the reason."""
    doubtful = {
        quantity: (cells, zero)
        for quantity, cells in table.series.items()
        if quantity.positive and (zero := _nothing_else(table, cells)).any()
    }
    if not doubtful:
        return
    from gbspec.data.absence import absent_channels, absent_states, why_present  # with sympy

    hidden = absent_channels(model, absent_states(model, items))
    places = {item.label: k for k, item in enumerate(items)}
    of_group = np.array([places.get(label, -1) for label in table.labels], dtype=np.int64)
    for quantity, (cells, zero) in doubtful.items():
        bad = np.flatnonzero(zero & ~hidden[of_group[table.group[cells.key]], quantity.index])
        if not len(bad):
            continue
        group = table.group[cells.key[bad]]
        reasons = {int(g): why_present(model, items[of_group[g]], quantity.index) for g in np.unique(group)}
        for reason in dict.fromkeys(reasons.values()):
            advice = (
                f"zeros do not count where a state is absent from a trajectory, but {reason}; {_UNDETECTED}; `noise "
                "normal(…)` accepts zeros"
            )
            same = np.array([reasons[int(g)] == reason for g in group])
            _report(table, quantity, cells, bad[same], advice, findings)


def _nothing_else(table: Records, cells: Series) -> Mask:
    """Which cells [n] are of trajectories whose values are all exactly 0, without limits."""
    other = cells.value != 0
    if cells.side is not None:
        other |= cells.side != 0
    group = table.group[cells.key]
    found = np.zeros(len(table.labels), dtype=np.bool_)
    found[group[other]] = True
    return np.asarray(~found[group], dtype=np.bool_)


def _report(
    table: Records, quantity: Quantity, cells: Series, bad: NDArray[np.intp], advice: str, findings: Findings
) -> None:
    for i, notes in shown(bad, "cells"):
        row = int(cells.row[i])
        findings.error(
            "GB724",
            f"`{quantity.column}` is {cells.value[i]:g} in row {row}, and lognormal noise needs values above zero",
            Cell(table.path, row, quantity.column),
            help=advice,
            notes=notes,
        )
