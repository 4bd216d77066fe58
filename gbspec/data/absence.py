"""States that are absent from a trajectory: measured as exactly 0 throughout, and kept there by their balances.

Such zeros tell nothing of the noise, since every model has them exactly, and nothing of the start: a solution that
began beside zero would be another one, of a species that is there, and might grow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from gbspec.arrays import Mask
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.ir import Model


def absent_states(model: Model, items: Sequence[Trajectory]) -> Mask:
    """The states [N, n_states] that are absent from each of N trajectories."""
    out = np.zeros((len(items), len(model.states)), dtype=np.bool_)
    if model.diffusions or model.delays:
        return out
    places: dict[int, list[int]] = {}
    for j, channel in enumerate(model.channels):
        if channel.state is not None and model.states[channel.state].initial.kind == "measured":
            places.setdefault(channel.state, []).append(j)
    staying: dict[frozenset[int], frozenset[int]] = {}
    for k, item in enumerate(items):
        zero = frozenset(
            i for i, each in places.items() if all(_zero(item, j) for j in each) and not _changed(model, item, i)
        )
        if not zero:
            continue
        if zero not in staying:
            staying[zero] = _staying(model, zero)
        out[k, sorted(staying[zero])] = True
    return out


def absent_channels(model: Model, absent: Mask) -> Mask:
    """The channels [N, C] that measure absent states [N, n_states]."""
    out = np.zeros((len(absent), len(model.channels)), dtype=np.bool_)
    for j, channel in enumerate(model.channels):
        if channel.state is not None:
            out[:, j] = absent[:, channel.state]
    return out


def present_values(model: Model, trajectories: Trajectories, absent: Mask | None = None) -> Trajectories:
    """The trajectories without the values of states that are `absent` (None: those of `absent_states`)."""
    hidden = absent_channels(model, absent_states(model, trajectories.items) if absent is None else absent)
    items = tuple(_without(item, columns) for item, columns in zip(trajectories.items, hidden, strict=True))
    return replace(trajectories, items=items)


def present_item(model: Model, item: Trajectory) -> Trajectory:
    """A trajectory without the values of states that are absent from it."""
    (columns,) = absent_channels(model, absent_states(model, [item]))
    return _without(item, columns)


def _without(item: Trajectory, channels: Mask) -> Trajectory:
    """A trajectory without the values of some channels [C]."""
    return replace(item, values=np.where(channels, np.nan, item.values)) if channels.any() else item


def why_present(model: Model, item: Trajectory, channel: int) -> str:
    """Why the zeros of a channel, which has no other values in a trajectory, are none of an absent state."""
    state, name = model.channels[channel].state, model.channels[channel].name
    if state is None:
        return f"`{name}` is an expression and no state"
    name = model.states[state].name
    if model.diffusions or model.delays:
        return f"none is taken to be so in a model with {'disturbances' if model.diffusions else 'delays'}"
    if model.states[state].initial.kind != "measured":
        return (
            f"the start of `{name}` is {'learned' if not model.states[state].initial.known else 'given'} in the model"
        )
    if not _zero(item, channel):
        return f"`{name}` is not measured at the start of trajectory `{item.label}`"
    if _changed(model, item, state):
        return f"a dose or an event changes `{name}`"
    others = [j for j, one in enumerate(model.channels) if one.state == state]
    if not all(_zero(item, j) for j in others):
        return f"another channel of `{name}` has other values in trajectory `{item.label}`"
    return f"the balance of `{name}` is not 0 where `{name}` is 0, so that it would not stay absent"


def _zero(item: Trajectory, channel: int) -> bool:
    """Whether a channel is measured at the start, and all of its values are 0."""
    values = item.values[:, channel]
    known = values[np.isfinite(values)]
    censored = item.limits is not None and bool((item.limits.side[:, channel] != 0).any())
    begins = bool(len(values)) and item.times[0] == item.start and values[0] == 0
    return begins and not censored and bool((known == 0).all())


def _changed(model: Model, item: Trajectory, state: int) -> bool:
    """Whether something else than its balance changes a state: a dose of this trajectory, or an event."""
    name = model.states[state].name
    dosed = any(
        dose.state == name and bool(np.any(given.amounts != 0))
        for dose, given in zip(model.doses, item.doses, strict=True)
    )
    return dosed or any(name in dict(event.values) for event in model.events)


def _staying(model: Model, zero: frozenset[int]) -> frozenset[int]:
    """Those of the states `zero` that stay at 0, as long as they are 0 together."""
    while zero:
        nothing = {model.states[i].symbol: sympy.S.Zero for i in zero}
        balances = [b.xreplace(nothing) for b in model.inlined([model.balances[i] for i in sorted(zero)])]
        calls = {call for balance in balances for call in balance.atoms(AppliedUndef) if _promised(model, call)}
        balances = [balance.xreplace(dict.fromkeys(calls, sympy.S.Zero)) for balance in balances]
        kept = frozenset(i for i, balance in zip(sorted(zero), balances, strict=True) if balance.is_zero)
        if kept == zero:
            break
        zero = kept
    return zero


def _promised(model: Model, call: AppliedUndef) -> bool:
    """Whether a contract says that an unknown function is 0 at the arguments of a call."""
    unknown = next((one for one in model.unknowns if one.name == call.func.__name__), None)
    if unknown is None:
        return False
    given = dict(zip((one.name for one in model.networks[unknown.network].arguments), call.args, strict=True))
    return any(one.kind == "zero" and given.get(one.argument or "") == one.value for one in unknown.contracts)
