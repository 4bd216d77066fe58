"""The statements that describe disturbances, offered where residuals are autocorrelated."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir import Model, Range, logarithmic, new_name

SPELLED_OUT = 2
"""Of so many states each one's statements of a disturbance are written out; of more the first one's show how."""


def offered(
    found: Sequence[str], model: Model | None, rmse: Mapping[str, float], noise: Mapping[str, float] | None = None
) -> str:
    """What a model lacks that leaves autocorrelated residuals of the channels `found`: the statements of a disturbance,
    or more than those it has. Sizes begin with those of residuals: `rmse`, in the units of the channels, or of
    log-normal noise `noise`, of logarithms."""
    if model is None:
        return ""
    if model.marginal and any(k.distribution is not None for k in model.learnables):  # not offered with `diffusion`
        return ". What may help: further constants that differ between trajectories, or another model"
    if model.marginal:
        return ". What may help: another state, an unknown function, or another model"
    if model.diffusions:
        return ". The model lacks more: another state, another `diffusion`, or an unknown function"
    if model.events or model.delays:  # nor with these
        return ". What may help: another state, an unknown function, or another model"
    measured = {c.state: c.name for c in model.channels if c.name in found and c.state is not None}
    if not measured:
        return ". The statement `diffusion` describes random disturbances of states between measurements"
    sizes, exact = _disturbed(model, {index: rmse.get(channel, 0.0) for index, channel in measured.items()})
    # What is measured with an error in proportion spans orders of magnitude, and so does what disturbs it.
    logs = _of_logarithms(model)
    relative = {index for index in sizes if measured.get(index) in logs}
    sizes |= {index: (noise or {}).get(measured[index], math.nan) for index in relative}
    lines = [_statements(model, index, rounded(size), index in relative) for index, size in sizes.items()]
    starts = [rounded(size) for size in sizes.values()]
    names = [f"`{model.states[index].name}`" for index in sizes]
    listed = " and ".join(f"`{model.states[index].name}`" for index in exact)
    why = f", from which {listed} {'follows' if len(exact) == 1 else 'follow'} exactly," if exact else ""
    if len(names) <= SPELLED_OUT or 0 < len(relative) < len(sizes):
        return f". To describe disturbances of {' and '.join(names)}{why or ','} add the lines {', '.join(lines)}"
    others = f"{', '.join(names[1:])} (from {', '.join(starts[1:])})"
    return f". To describe disturbances of {names[0]}{why or ','} add the lines {lines[0]}; likewise for {others}"


def _of_logarithms(model: Model) -> list[str]:
    """The names of the channels whose noise is log-normal."""
    return [channel.name for channel, log in zip(model.channels, logarithmic(model), strict=True) if log]


def _statements(model: Model, index: int, start: str, relative: bool) -> str:
    """The lines that disturb a state by so much, or by such a part of it."""
    state, time = model.states[index], model.time.unit
    own = "1" if relative else state.unit
    unit = f" : {own}/{time}^0.5" if own and time else ""
    size = new_name(model, f"s_{state.name}")
    value = f"{size}*{state.name}" if relative else size
    return f"`learn {size}{unit} = {start} > 0` and `diffusion {state.name} = {value}`"


def _disturbed(model: Model, missed: Mapping[int, float]) -> tuple[dict[int, float], list[int]]:
    """The states to disturb for measured ones that are `missed` by so much, with sizes to begin with, and the measured
    ones that are left out.

    Of a position, whose balance is a rate alone, the rate is disturbed: disturbances of the position itself would make
    it jump, and the noise of measurement would be taken for such jumps. The size of a rate is that part of its range
    which is missed of the position's.
    """
    sizes, exact = dict[int, float](), list[int]()
    for index, size in missed.items():
        found = _driving(model, index)
        exact += [index] if found != [index] else []
        share = size / _width(model.states[index].range)
        for one in found:
            own = size if one == index else share * _width(model.states[one].range)
            sizes[one] = max(sizes.get(one, 0.0), own if math.isfinite(own) else 0.0)
    return sizes, exact


def _driving(model: Model, index: int) -> list[int]:
    """The states from which a state follows exactly, through others if need be; itself, if it has a balance of its own
    or if these follow from each other in turn."""
    found, seen = [index], {index}
    while True:
        each = {one: followed_exactly(model, one) for one in found}
        if not any(each.values()):
            return sorted(found)
        further = {to for one, others in each.items() for to in (others or [one])}
        if further & seen - {one for one, others in each.items() if not others}:
            return [index]
        found, seen = sorted(further), seen | further


def followed_exactly(model: Model, index: int) -> list[int]:
    """The other states whose sum with inputs, both times known constants, is the balance of a state, up to a known
    constant; none if it is anything else."""
    (rate,) = model.inlined([model.balances[index]])
    states = {one.symbol: i for i, one in enumerate(model.states)}
    known = {one.symbol for one in model.constants}
    parts = sorted(rate.free_symbols - known, key=str)
    found = sorted(states[symbol] for symbol in parts if symbol in states)
    varying = {*states, *(one.symbol for one in model.inputs)}
    if index in found or not varying.issuperset(parts) or rate.atoms(AppliedUndef):
        return []
    slopes = [rate.diff(symbol) for symbol in parts]
    rest = sympy.expand(rate - sum(slope * symbol for slope, symbol in zip(slopes, parts, strict=True)))
    return found if all(each.free_symbols <= known for each in (*slopes, rest)) else []


def _width(given: Range | None) -> float:
    return given.high - given.low if given is not None and given.bounded else math.nan


def rounded(size: float) -> str:
    """A start of this size, as one writes it: 0.3, 10."""
    return f"{float(f'{size:.1g}'):g}" if math.isfinite(size) and size > 0 else "0.1"
