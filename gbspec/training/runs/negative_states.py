"""What is said of learned starts and solutions below zero of states that are declared from zero."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbspec.data import below_zero
from gbspec.ir import Model
from gbspec.training.engines import Moments

MEANING = (
    "nothing keeps starts and solutions within declared ranges, and balances may mean nothing there, or have a pole "
    "(`S/(S + K)`) or the root of a negative number"
)


def negative_states(model: Model, solution: Moments, noise: Mapping[str, float]) -> dict[str, str]:
    """A sentence for each such state; `noise` has the standard deviations of the channels.

    Of the measured states only what is below zero by more than the noise counts.
    """
    every = np.concatenate([solution.initial, solution.after])
    starts, along = (below_zero(model, values, noise, every) for values in (solution.initial, every))
    found = {}
    for state in model.states:
        name = state.name
        if name in along and name in starts and state.initial.kind in ("learned", "measured"):
            found[name] = _of_start(model, name, starts[name], along[name])
        elif name in along:
            found[name] = (
                f"the learned solutions take `{name}` to {along[name]:.3g}, below 0, where its declared range begins: "
                f"{MEANING}. Balances keep it there if what takes from it vanishes with it (`max({name}, 0)`)"
            )
    return found


def _of_start(model: Model, name: str, start: float, lowest: float) -> str:
    (state,) = (one for one in model.states if one.name == name)
    taken = {one.name for one in (*model.states, *model.constants, *model.learnables, *model.inputs, *model.conditions)}
    constant = next(text for i in range(len(taken) + 1) if (text := f"{name}_{i}") not in taken)
    assert state.range is not None
    unit = f" : {state.unit}" if state.unit else ""
    value = "" if state.start is None else f" = {state.start:g}"
    high = f" in [0, {state.range.high:g}]" if state.range.bounded else " > 0"
    further = f" (and the solutions go to {lowest:.3g})" if lowest < start else ""
    return (
        f"the learned start of `{name}` is {start:.3g}{further}, below 0, where its declared range begins: {MEANING}. "
        f"A constant keeps it: `learn {constant}{unit}{value}{high}`, with `per trajectory` where trajectories differ, "
        f"and `initial {name} = {constant}`"
    )
