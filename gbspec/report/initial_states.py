"""Learned, bred and true initial states as a figure: each state over its reference, then how far off in each mode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gbspec.analysis.prediction.start_comparison import InitialStates
from gbspec.arrays import Array
from gbspec.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ACROSS = 3
FLOOR = 1e-12
"""Differences below this are drawn here: a logarithmic axis has no zero."""
LEARNED: dict[str, Any] = {"marker": "o", "markersize": 4, "color": style.LEARNED, "linestyle": "none"}
BRED: dict[str, Any] = {"marker": "^", "markersize": 4, "color": style.MEASURED, "linestyle": "none"}


def initial_states(found: InitialStates) -> Figure:
    """Above one panel a state, learned and bred over the reference; below one a mode, slowest first."""
    count = len(found.states)
    columns = min(ACROSS, count)
    rows = -(-count // columns)
    with style.styled():
        made = style.figure(max(3.4 * columns, 5.4), 2.7 * 2 * rows + 0.4)
        grid = made.subplots(2 * rows, columns, squeeze=False)
        for axes in grid.ravel():
            axes.set_visible(False)
        for i, name in enumerate(found.states):
            _state(grid[i // columns, i % columns], found, i, name)
            _mode(grid[rows + i // columns, i % columns], found, i)
        handles: dict[str, Any] = {}
        for axes in grid.ravel():
            handles.update({label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)})
        made.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
        return made


def _state(axes: Axes, found: InitialStates, i: int, name: str) -> None:
    axes.set_visible(True)
    reference = np.array([item.bred[i] if item.true is None else item.true[i] for item in found.items])
    axes.plot(reference, [item.learned[i] for item in found.items], label="learned", zorder=3, **LEARNED)
    if found.items[0].true is not None:
        axes.plot(reference, [item.bred[i] for item in found.items], label="bred", zorder=4, **BRED)
    ends = [float(reference.min()), float(reference.max())]
    axes.plot(ends, ends, color=style.MUTED, linewidth=1, zorder=2)
    axes.set_xlabel(f"{name}, {found.reference}")
    axes.set_ylabel(name)


def _mode(axes: Axes, found: InitialStates, i: int) -> None:
    axes.set_visible(True)
    places = np.arange(len(found.items))
    axes.semilogy(places, _drawn([item.learned_off[i] for item in found.items]), label="learned", zorder=3, **LEARNED)
    bred = [item.bred_off[i] for item in found.items if item.bred_off is not None]
    if bred:
        axes.semilogy(places, _drawn(bred), label="bred", zorder=4, **BRED)
    rate = found.rates[i]
    pace = f"decays in {-1 / rate:.3g}" if rate < 0 else "grows"
    axes.set_title(f"mode {i + 1}: {pace}")
    axes.set_xlabel("trajectory")
    axes.set_ylabel(f"off {found.reference}")


def _drawn(sizes: list[float]) -> Array:
    return np.asarray(np.maximum(sizes, FLOOR))
