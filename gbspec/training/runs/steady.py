"""Whether doses in a steady state were preceded by enough of them: the solution must repeat from dose to dose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import Evaluator, GeneratedModule
from gbspec.data import Trajectory
from gbspec.diagnostics import ComputationError

TOLERANCE = 1e-3
"""The change from dose to dose, relative to the state, from which a warning is given."""
MOST = 20
"""The trajectories that are looked at."""


def unsteady(instance: GeneratedModule, items: Sequence[Trajectory], constants: Array) -> list[str]:
    """A sentence for the trajectory, among the first of those that begin in a steady state, that is farthest from it;
    `constants` [trajectories, n] are those of each."""
    found: list[tuple[float, str, str, int]] = []
    chosen = [(i, item) for i, item in enumerate(items) if item.run_in is not None][:MOST]
    if not chosen:
        return []
    evaluator = Evaluator(instance)
    for i, item in chosen:
        if item.run_in is None:
            continue
        times = np.array([item.begins - item.run_in.interval, item.begins])
        own = constants[min(i, len(constants) - 1)]
        x0 = evaluator.initial(np.zeros(evaluator.n_states), item.condition, own, item.inputs, item.start)
        try:
            before, after = evaluator.integrate(
                x0, times, item.condition, item.inputs, item.start, doses=item.doses, constants=own, rtol=1e-7
            )
        except (ComputationError, ValueError):
            continue
        change = np.abs(after - before) / np.maximum(np.abs(after), np.finfo(float).tiny)
        change = np.where(np.abs(after - before) <= TOLERANCE * np.abs(after).max(initial=0.0), 0.0, change)
        worst = int(np.argmax(change))
        found.append((float(change[worst]), item.label, instance.states[worst], item.run_in.doses))
    share, label, state, doses = max(found, default=(0.0, "", "", 0))
    if not share > TOLERANCE:
        return []
    return [
        f"trajectory `{label}` does not begin in a steady state: after {doses} doses `{state}` still changes by "
        f"{share:.2g} of itself from dose to dose; give a larger number of doses before it in the column `ss_…`"
    ]
