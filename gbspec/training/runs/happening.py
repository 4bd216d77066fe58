"""What a finished fit says of its events: which never happen, and which come and go within the uncertainty.

Derivatives, and with them standard deviations and intervals, hold as long as the same events happen. Where a solution
grazes a threshold, a small change of a constant adds or removes an event, and its derivatives do not tell of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import sympy
import torch

from gbspec.arrays import Array
from gbspec.ir import Event, Expr, Learnable, Model
from gbspec.runs import Covariance
from gbspec.training.engines import Engine, Happened, happened

DEVIATIONS = 2.0
"""Events are counted so many standard deviations from the fit, along each principal axis of the covariance."""


def said_of_events(engine: Engine, theta: Array, covariance: Covariance | None) -> list[str]:
    """Sentences about the events of whole solutions at a vector; none where the engine does not count them."""
    found, model = happened(engine, theta), engine.problem.model
    if found is None:
        return []
    never = [event for event, count in zip(model.events, found.counts.sum(0), strict=True) if not count]
    return [*(_never(model, event) for event in never), *_coming_and_going(engine, theta, covariance, found)]


def _never(model: Model, event: Event) -> str:
    """The sentence for an event that does not happen."""
    only = ", ".join(f"`{name}`" for name in only_in(model, event))
    of_constants = (
        f", so that nothing moves {only} from where the fit began: if the event happens in the data, begin where the "
        "solutions reach it (other starting values or bounds)"
        if only
        else ""
    )
    return f"the event `{event.name}` never happens in the fitted solutions{of_constants}"


def only_in(model: Model, event: Event) -> list[str]:
    """The learned constants that nothing but an event depends on."""
    others = [part for other in model.events if other is not event for part in _parts(other)]
    values = [channel.value for channel in model.channels]
    started = [state.initial.value for state in model.states if state.initial.value is not None]
    used = {
        symbol
        for value in model.inlined([*model.balances, *values, *started, *others])
        for symbol in value.free_symbols
    }
    own = {symbol for value in model.inlined(_parts(event)) for symbol in value.free_symbols}
    return [learnable.name for learnable in model.learnables if learnable.symbol in own - used]


def _symbols(model: Model, values: Sequence[Expr]) -> set[sympy.Basic]:
    return {symbol for value in model.inlined(values) for symbol in value.free_symbols}


def _parts(event: Event) -> list[Expr]:
    """The expressions of an event."""
    timing = () if event.timing is None else (event.timing.at, event.timing.every, event.timing.until)
    return [
        part for part in (event.guard, event.rank, *timing, *(value for _, value in event.values)) if part is not None
    ]


def _coming_and_going(engine: Engine, theta: Array, covariance: Covariance | None, found: Happened) -> list[str]:
    """A sentence for the events whose number changes within the uncertainty of the constants."""
    model, now = engine.problem.model, found.counts
    least, most, changed = now.copy(), now.copy(), np.zeros(now.shape, dtype=bool)
    for vector in _around(engine, theta, covariance):
        there = happened(engine, vector)
        if there is not None:
            changed |= there.counts != now
            least, most = np.minimum(least, there.counts), np.maximum(most, there.counts)
    said = []
    for k in np.flatnonzero(changed.any(0)):
        i = int(np.argmax(most[:, k] - least[:, k]))
        label = engine.problem.packed.labels[i]
        said.append(
            f"`{model.events[k].name}` ({now[i, k]} times in trajectory `{label}`, {least[i, k]} to {most[i, k]})"
        )
    if not said:
        return []
    return [
        f"within two standard deviations of the constants events come and go: {', '.join(said)}. Standard deviations "
        "and intervals hold while the same events happen: do not rely on them here, and compare `--effort high`, or "
        "other seeds"
    ]


def _around(engine: Engine, theta: Array, covariance: Covariance | None) -> Iterator[Array]:
    """Vectors two standard deviations away along the principal axes of the shared constants."""
    parameters = engine.parameters
    if covariance is None or not np.isfinite(covariance.conditional).all():
        return
    scale = parameters.bijections(parameters.shared)
    constants = scale.to_natural(torch.from_numpy(theta[parameters.places])).numpy()
    shared = [parameters.model.learnables[i] for i in parameters.shared]
    place = [[learnable.name for learnable in shared].index(name) for name in covariance.constants]
    values, axes = np.linalg.eigh(covariance.conditional)
    for value, axis in zip(values, axes.T, strict=True):
        for sign in (-1, 1):
            moved, vector = constants.copy(), theta.copy()
            moved[place] += sign * DEVIATIONS * np.sqrt(max(value, 0.0)) * axis
            vector[parameters.places] = scale.from_natural(_within(shared, moved))
            yield vector


def _within(learnables: Sequence[Learnable], constants: Array) -> Array:
    """Constants moved into their ranges, by a little from the bounds."""
    low, high = (np.array([getattr(item.range, name) for item in learnables]) for name in ("low", "high"))
    width = np.where(np.isfinite(high - low), high - low, np.abs(constants))
    return np.asarray(np.clip(constants, low + 1e-6 * width, high - 1e-6 * width), dtype=np.float64)
