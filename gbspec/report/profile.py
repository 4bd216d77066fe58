"""The profile likelihood of a constant as a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.report import style
from gbspec.training.profile.likelihood import Profile

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(found: Profile, truth: float | None = None) -> Figure:
    """Deviance over the constant's value with the 90 % threshold and interval; below it the other constants."""
    names = list(found.points[0].others) if found.points else []
    with style.styled():
        made = style.figure(5.6, 3.2 + 1.2 * len(names))
        ratios = [2.4, *([1.0] * len(names))]
        column = made.subplots(1 + len(names), 1, squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
        values = [point.value for point in found.points]
        axes = column[0]
        axes.plot(values, [p.deviance for p in found.points], color=style.LEARNED, marker="o", markersize=4,
                  label="deviance", zorder=3)  # fmt: skip
        slow = [p for p in found.points if not p.converged]
        if slow:
            look = {"markerfacecolor": "white", "markeredgecolor": style.LEARNED, "markersize": 5, "zorder": 4}
            axes.plot([p.value for p in slow], [p.deviance for p in slow], "o", label="not converged", **look)
        axes.axhline(found.threshold, color=style.MEASURED, linewidth=1.2, label="90 %", zorder=2)
        inside = found.low if found.low is not None else values[0], found.high if found.high is not None else values[-1]
        if found.settled:
            axes.axvspan(*inside, color=style.LEARNED, alpha=0.1, linewidth=0, label="interval")
        if truth is not None:
            axes.axvline(truth, label="truth", zorder=4, **style.DASHED)
        axes.set_ylim(-0.2, max(2.2 * found.threshold, 1.0))
        axes.set_ylabel("deviance")
        ends = [f"{end:.5g}" if end is not None else "open" for end in (found.low, found.high)]
        interval = f"90 %: {ends[0]} to {ends[1]}" if found.settled else "the fits have not converged"
        axes.set_title(f"{found.name} = {found.estimate:.5g}, {interval}")
        for panel, name in zip(column[1:], names, strict=True):
            panel.plot(values, [p.others[name] for p in found.points], color=style.LEARNED, marker="o", markersize=3)
            panel.set_ylabel(name)
        column[-1].set_xlabel(found.name)
        handles, labels = axes.get_legend_handles_labels()
        made.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        return made
