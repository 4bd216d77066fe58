"""Likelihoods of innovations that grow without limit as a learned noise goes to zero.

A start that is learned follows the first value, whose variance is then that of the noise alone.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from gbspec.ir import Model, in_language
from gbspec.runs import LikelihoodRecord


def said_of_unbounded(likelihood: LikelihoodRecord, model: Model | None) -> list[str]:
    """What is to be said of a likelihood that grows without limit as learned noises go to zero."""
    names = likelihood.unbounded or ()
    if not names:
        return []
    said = [] if model is None else _learned_starts(model, names)
    starts = f", as where a start is learned that is measured ({_quoted(said)})" * bool(said)
    constants = (
        "Constants are those of the restricted likelihood, in which starts and constants are integrated out and such "
        "values do not count. "
    ) * (likelihood.maximum is not False)
    out = f"leave {_quoted(said)} out (the first value then gives the start, with its noise), or " * bool(said)
    return [
        f"the likelihood has no maximum: it grows without limit as the learned noise of {_quoted(names)} goes to zero, "
        f"since the fit has some of the values exactly{starts}. There are no AIC and BIC, and `compare` refuses the "
        f"run. {constants}For a maximum {out}state the noise: `noise normal(…)`"
    ]


def _learned_starts(model: Model, names: Collection[str]) -> list[str]:
    """The statements by which the starts of the states that these channels measure are learned."""
    learned, said = {k.symbol for k in model.learnables}, []
    measured = {channel.state for channel in model.channels if channel.name in names}
    for initial, name in [(one.initial, one.name) for i, one in enumerate(model.states) if i in measured]:
        if initial.kind == "learned":
            said.append(f"initial {name} learn")
        elif initial.value is not None and initial.value.free_symbols & learned:
            said.append(f"initial {name} = {in_language(initial.value, model.conditions)}")
    return said


def _quoted(names: Iterable[str]) -> str:
    return " and ".join(f"`{name}`" for name in names)
