"""What is said of trajectories that seem to go on with one of the training data, but begin again at a given start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.solutions import labels_of, learned_positions

if TYPE_CHECKING:
    from gbspec.data import Trajectories
    from gbspec.runs import Run


def said_of_restarts(run: Run, trajectories: Trajectories) -> list[str]:
    """A warning of trajectories that begin after the last row that the training had of their label, where the model
    gives a start: nothing says that they are others, and nothing that was learned of the first one is used. Runs of
    older versions do not know when their trajectories end."""
    given = [f"`{state.name}`" for state in run.model.states if state.initial.known]
    member = run.members[0]
    ends = dict(zip(labels_of(member), np.asarray(member.info.get("ends") or (), dtype=float), strict=False))
    learned = learned_positions(member, trajectories, run.fit.data)
    found = [
        item
        for item, position in zip(trajectories.items, learned, strict=True)
        if position is None and item.label in ends and item.begins > ends[item.label]
    ]
    if not found or not given:
        return []
    listed = ", ".join(f"`{item.label}`" for item in found[:5]) + (", ..." if len(found) > 5 else "")
    first, one = found[0], len(found) == 1
    what = f"trajectory {listed} begins" if one else f"trajectories {listed} begin"
    when = f"at {first.begins:.6g}" + ("" if one else f" (`{first.label}`)")
    return [
        f"{what} {when}, after the last row that the training had of {'this label' if one else 'these labels'} "
        f"({ends[first.label]:.6g}), and {'begins' if one else 'begin'} again there: the model gives the start of "
        f"{', '.join(given)}. If {'it goes' if one else 'they go'} on with what was measured before, give the rows of "
        "the training too: later ones are then predicted from what was learned of these"
    ]
