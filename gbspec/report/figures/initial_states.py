"""Learned, bred and true initial states: each state over its reference, then the differences in each mode."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from gbspec.analysis import InitialStates
from gbspec.arrays import Array
from gbspec.data import evenly_spaced
from gbspec.report import collect
from gbspec.report.description import Axis, Block, Figure, Panel, Points, diagonal, wrapped
from gbspec.report.source import Source
from gbspec.report.style import LEARNED, MEASURED

IN_FILE, ON_PAGE = 40, 24
"""Number of trajectories that are compared if none are named."""
ACROSS = 3
FLOOR = 1e-12
"""Smaller differences are drawn at this value: a logarithmic axis has no zero."""


def build(source: Source) -> Figure:
    """The initial states of some trajectories. Raises `UserError` (GB876) if none were learned."""
    fitted = source.fitted
    most = ON_PAGE if source.page else IN_FILE
    found = collect.initial_states(fitted, source.chosen() or evenly_spaced(len(fitted.data), most))
    known = {state.name for state in fitted.model.states if state.initial.known}
    return figure(found, collect.units(fitted.model), known, fitted.model.time.unit or "")


def figure(
    found: InitialStates,
    units: Mapping[str, str] | None = None,
    known: Collection[str] = frozenset(),
    time: str = "",
) -> Figure:
    """Above, one panel per state, learned and bred over the reference; below, one per mode, slowest first.

    States whose initial value the model gives (`known`) have no panel: they were not learned. `time` is its unit.
    """
    states = tuple(
        _state(found, i, name, (units or {}).get(name, "")) for i, name in enumerate(found.states) if name not in known
    )
    modes = tuple(_mode(found, i, time) for i in range(len(found.states)))
    return Figure(((Block((*wrapped(states, ACROSS), *wrapped(modes, ACROSS)), "below"),),))


def _state(found: InitialStates, i: int, name: str, unit: str) -> Panel:
    reference = np.array([item.bred[i] if item.true is None else item.true[i] for item in found.items])
    marks = [_learned(reference, np.array([item.learned[i] for item in found.items]), found)]
    if found.items[0].true is not None:
        marks.append(_bred(reference, np.array([item.bred[i] for item in found.items]), found))
    line = diagonal(float(reference.min()), float(reference.max()))
    return Panel((line, *marks), Axis(f"{name}, {found.reference}", unit), Axis(name, unit), width=3.4, height=2.7)


def _mode(found: InitialStates, i: int, time: str) -> Panel:
    places = np.arange(len(found.items), dtype=np.float64)
    marks = [_learned(places, np.maximum([item.learned_off[i] for item in found.items], FLOOR), found)]
    bred = [item.bred_off[i] for item in found.items if item.bred_off is not None]
    if bred:
        marks.append(_bred(places, np.maximum(bred, FLOOR), found))
    rate = found.rates[i]
    pace = f"decays in {-1 / rate:.3g} {time}".rstrip() if rate < 0 else "grows"
    distance = Axis(f"distance from {found.reference}", log=True)
    x = Axis("trajectory", names=tuple(item.trajectory for item in found.items))
    return Panel(tuple(marks), x, distance, f"mode {i + 1}: {pace}", width=3.4, height=2.7)


def _learned(x: Array, y: Array, found: InitialStates) -> Points:
    return Points(x, y, "learned", LEARNED, 4, layer=3, hover=_labels(found))


def _bred(x: Array, y: Array, found: InitialStates) -> Points:
    return Points(x, y, "bred", MEASURED, 4, "up", layer=4, hover=_labels(found))


def _labels(found: InitialStates) -> tuple[str, ...]:
    return tuple(f"trajectory {item.trajectory}" for item in found.items)
