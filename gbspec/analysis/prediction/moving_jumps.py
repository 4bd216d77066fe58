"""Learned constants that move the times of events or doses, and what predictions say where they have no intervals.

Where such a time lies between two rows the data do not tell, or hardly so: until it passes a row, only values between
rows change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.ir import Expr, Model

if TYPE_CHECKING:
    from gbspec.runs import Run


def said_of_moving_jumps(run: Run) -> list[str]:
    """A warning where constants that all trajectories share have no interval, and move the times of events or doses."""
    fitted, moving = run.fit.constants, moving_constants(run.model)
    names = [
        k.name
        for k in run.model.learnables
        if k.name in moving and not k.per_trajectory and k.name not in run.values
        and k.name in fitted and fitted[k.name].interval is None
    ]  # fmt: skip
    if not names:
        return []
    listed = " and ".join(f"`{name}` (learned: {fitted[name].value:.5g})" for name in names)
    one = len(names) == 1
    return [
        f"{listed} {'has' if one else 'have'} no interval, and an event or a dose comes at a time that depends on "
        f"{'it' if one else 'them'}: intervals hold while it comes between the same rows as in the fit. A row between "
        "these, nearer to it than the rows of the training data, may lie on its other side"
    ]


def moving_intervals(run: Run) -> dict[str, tuple[float, float]]:
    """The intervals of the learned constants that move events or doses, of those that have one."""
    moving = moving_constants(run.model)
    return {name: one.interval for name, one in run.fit.constants.items() if name in moving and one.interval}


def moving_constants(model: Model) -> frozenset[str]:
    """The learned constants that the times of events or doses depend on."""
    moving = {symbol for value in _moving(model) for symbol in value.free_symbols}
    return frozenset(k.name for k in model.learnables if k.symbol in moving)


def _moving(model: Model) -> tuple[Expr, ...]:
    """What the times of events and of arrivals of doses follow from."""
    parts = [dose.lag for dose in model.doses]
    for event in model.events:
        timing = event.timing
        parts += [event.guard] if timing is None else [timing.at, timing.every, timing.until]
    return model.inlined([part for part in parts if part is not None])
