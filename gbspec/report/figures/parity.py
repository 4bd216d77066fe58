"""The right-hand side of each balance, learned against true, at the fitted states of the measured rows."""

from __future__ import annotations

import numpy as np

from gbspec.analysis import input_values
from gbspec.arrays import Array
from gbspec.report.collect import Fitted
from gbspec.report.description import Block, Figure, wrapped
from gbspec.report.figures.functions import ACROSS, parity_panel
from gbspec.report.source import MissingError, Source

MOST_POINTS = 1200
"""Number of points in a panel."""


def build(source: Source) -> Figure:
    """One panel per state."""
    fitted = source.fitted
    if fitted.truth is None:
        raise MissingError("the model states no truth to compare with", "fit")
    if fitted.model.delays:
        raise MissingError("the right-hand side of a model with delays depends on the past, not on a state", "fit")
    true, learned = _values(fitted)
    every = max(1, len(true) // MOST_POINTS)
    # A balance without anything learned is the same in both to the last digits, and shows nothing
    shown = [i for i in range(true.shape[1]) if not np.allclose(true[:, i], learned[:, i], rtol=1e-12, atol=0.0)]
    if not shown:
        raise MissingError("nothing in the balances is learned", "fit")
    time = fitted.model.time
    panels = tuple(
        parity_panel(
            f"d{state.name}/d{time.name}",
            true[::every, i],
            learned[::every, i],
            f"{state.unit}/{time.unit}" if state.unit and time.unit else "",
        )
        for i, state in enumerate(fitted.model.states)
        if i in shown
    )
    return Figure(((Block(wrapped(panels, ACROSS)),),))


def _values(fitted: Fitted) -> tuple[Array, Array]:
    """True and learned (mean of the members) right-hand sides, both [P, n]."""
    if fitted.truth is None:
        raise ValueError("parity needs a truth")
    true, learned = [], []
    for index, item in enumerate(fitted.data.items):
        states, _ = fitted.solutions(index, item.times)
        rows = np.isfinite(states).all(axis=(0, 2))
        inputs = input_values(fitted.model, item, item.times)[rows]
        at = item.times[rows], states.mean(axis=0)[rows], item.condition, inputs
        members = [e.rhs_many(*at, fitted.start(m, index).constants) for m, e in enumerate(fitted.evaluators)]
        learned.append(np.mean(members, axis=0))
        true.append(fitted.truth.rhs_many(*at))
    return np.concatenate(true), np.concatenate(learned)
