"""The delays of a model as methods of the generated class."""

from __future__ import annotations

import json
from dataclasses import replace

from gbspec.backends.module.equations import PARAMETERS, body_of, scope
from gbspec.backends.module.writing import comma, method_text
from gbspec.backends.printing import Assignment, Names, temporary
from gbspec.ir import Expr, Model, delayed_inputs


def methods(model: Model) -> list[str]:
    """`delays`, `delayed_inputs`, `echoes`, `lags`, `delayed`, `history` and `past`, in models that have delays."""
    if not model.delays:
        return []
    lags = list(dict.fromkeys(delay.lag for delay in model.delays))
    table = [f"({json.dumps(d.name, ensure_ascii=False)}, {lags.index(d.lag)})" for d in model.delays]
    head = "# what is delayed, and by which of `lags`; in this order their values follow the inputs"
    places = comma(str(place) for place in delayed_inputs(model))
    moving = {one.symbol for one in (*model.states, *model.algebraics)}
    again = any(moving & value.free_symbols for value in model.inlined(one.value for one in model.delays))
    echoes = "# how many delays later a change may still show: what is delayed of states does so again and again"
    past = method_text(
        "@classmethod",
        "past",
        ["cls", "given", "begin", "start", "inputs"],
        "The solution so far of a batch, for its delays; `given`: conditions, constants, networks.",
        ["return _Past(cls, given, begin, start, inputs)"],
    )
    own = replace(model, delays=())  # what is delayed holds no delays itself
    return [
        f"{head}\ndelays: ClassVar[tuple[tuple[str, int], ...]] = ({comma(table)})",
        f"# the inputs whose changes show again\ndelayed_inputs: ClassVar[tuple[int, ...]] = ({places})",
        f"{echoes}\nechoes: ClassVar[int] = {4 if again else 1}",
        _lags(own, lags),
        _delayed(own, model),
        _history(own),
        past,
    ]


def _lags(model: Model, lags: list[Expr]) -> str:
    """`lags`: the times of the delays."""
    names = Names(PARAMETERS)
    for item in (*model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    outputs = [Assignment(temporary(f"lag{i}"), lag, f"lag{i}") for i, lag in enumerate(lags)]
    lines = body_of(model, outputs, names)
    lines.append(f"return ({comma(names[output.symbol] for output in outputs)})")
    document = "The times by which quantities are delayed, each once."
    return method_text("@classmethod", "lags", ["cls", "math", "condition", "constants"], document, lines)


def _delayed(model: Model, whole: Model) -> str:
    """`delayed`: what is delayed, at its own time."""
    names = scope(model)
    outputs = [Assignment(temporary(f"value{i}"), d.value, f"value{i}") for i, d in enumerate(whole.delays)]
    lines = body_of(model, outputs, names)
    lines.append(f"return math.pack(state, ({comma(names[output.symbol] for output in outputs)}))")
    parameters = ["cls", "math", names[model.time.symbol], "state", "condition", "inputs", "constants", "networks"]
    document = "The quantities that are delayed, from the state and the inputs of an earlier time."
    return method_text("@classmethod", "delayed", parameters, document, lines)


def _history(model: Model) -> str:
    """`history`: the state before the start."""
    names = scope(model)
    outputs = {
        s.name: Assignment(temporary(f"history{i}"), s.history, f"{s.name}_before")
        for i, s in enumerate(model.states)
        if s.history is not None
    }
    read = {s.symbol for s in model.states if s.name not in outputs}
    lines = body_of(model, list(outputs.values()), names, read)
    values = (names[outputs[s.name].symbol if s.name in outputs else s.symbol] for s in model.states)
    lines.append(f"return math.pack(state, ({comma(values)}))")
    parameters = ["cls", "math", names[model.time.symbol], "state", "condition", "constants"]
    document = "The state at a time before the start, where it was `state`."
    return method_text("@classmethod", "history", parameters, document, lines)
