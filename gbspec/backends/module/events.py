"""The events of a model as methods of the generated class."""

from __future__ import annotations

import json
from collections.abc import Sequence

import sympy

from gbspec.backends.module.equations import PARAMETERS, body_of, kept, scope, state_with
from gbspec.backends.module.writing import comma, method_text
from gbspec.backends.printing import Assignment, Names, temporary
from gbspec.ir import Expr, Model


def methods(model: Model) -> list[str]:
    """`events`, `guards`, `ranks`, `timing` and `happen`, in models that have events."""
    if not model.events:
        return []
    table = [f"({json.dumps(e.name, ensure_ascii=False)}, {e.timing is not None}, {e.armed})" for e in model.events]
    head = "# name, whether it happens at given times, whether a condition that is true at the start counts"
    found = [f"{head}\nevents: ClassVar[tuple[tuple[str, bool, bool], ...]] = ({comma(table)})", _guards(model)]
    if model.switches:
        head = "# how many of the last pairs of events are switches of right-hand sides"
        found.append(f"{head}\nswitches: ClassVar[int] = {len(model.switches)}")
    kind = "_Switched" if model.switches else "_Events"
    cutting = method_text(
        "@classmethod",
        "cutting",
        ["cls", "given", "quiet", "band", "strict"],
        "Steps that are cut where events happen; `given`: conditions, constants, networks, `quiet`: for the search.",
        [f"return {kind}(cls, given, quiet, band, strict)"],
    )
    found.append(cutting)
    if any(e.rank is not None for e in model.events):
        found.append(_ranks(model))
    return [*found, *([_timing(model)] if any(e.timing is not None for e in model.events) else []), _happen(model)]


def _guards(model: Model) -> str:
    """`guards`: a number for each event with a condition."""
    guards = [(event.name, event.guard) for event in model.events if event.guard is not None]
    document = "For each event with a condition a number that becomes positive where the condition becomes true."
    return _numbers(model, "guards", guards, document)


def _ranks(model: Model) -> str:
    """`ranks`: the priority of each event."""
    ranks = [(e.name, sympy.Float(e.priority) if e.rank is None else e.rank) for e in model.events]
    return _numbers(model, "ranks", ranks, "The priority of each event, in models where one is computed.")


def _numbers(model: Model, method: str, values: Sequence[tuple[str, Expr]], document: str) -> str:
    """A method with a number for each of some events."""
    names = scope(model)
    outputs = [Assignment(temporary(f"number{i}"), value, name) for i, (name, value) in enumerate(values)]
    lines = body_of(model, outputs, names)
    lines.append(f"return math.pack(state, ({comma(names[output.symbol] for output in outputs)}))")
    parameters = ["cls", "math", names[model.time.symbol], "state", "condition", "inputs", "constants", "networks"]
    return method_text("@classmethod", method, parameters, document, lines)


def _timing(model: Model) -> str:
    """`timing`: first time, interval and last time of each timed event."""
    names = Names(PARAMETERS)
    for item in (*model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    parts: list[list[Expr | None]] = [
        [e.timing.at, e.timing.every, e.timing.until] for e in model.events if e.timing is not None
    ]
    outputs: dict[tuple[int, int], Assignment] = {
        (i, j): Assignment(temporary(f"time{i}_{j}"), value, ("first", "every", "last")[j])
        for i, group in enumerate(parts)
        for j, value in enumerate(group)
        if value is not None
    }
    lines = body_of(model, list(outputs.values()), names)
    groups = [
        f"({comma(names[outputs[i, j].symbol] if (i, j) in outputs else 'None' for j in range(3))})"
        for i in range(len(parts))
    ]
    lines.append(f"return ({comma(groups)})")
    document = "For each event at given times the first one, the interval, and the last one."
    return method_text("@classmethod", "timing", ["cls", "math", "condition", "constants"], document, lines)


def _happen(model: Model) -> str:
    """`happen`: the state after each event."""
    names = scope(model)
    outputs: dict[tuple[int, str], Assignment] = {
        (i, name): Assignment(temporary(f"event{i}_{name}"), value, f"{name}_after_{event.name}")
        for i, event in enumerate(model.events)
        for name, value in event.values
    }
    lines = body_of(model, list(outputs.values()), names, kept(model, ()))
    for i, event in enumerate(model.events):
        new = {name: outputs[i, name].symbol for name, _ in event.values}
        lines.append(f"after{i} = {state_with(model, new, names)}")
    lines.append(f"return ({comma(f'after{i}' for i in range(len(model.events)))})")
    parameters = ["cls", "math", names[model.time.symbol], "state", "condition", "inputs", "constants", "networks"]
    return method_text("@classmethod", "happen", parameters, "The state after each event.", lines)
