"""The steady start of a model as a method of the generated class."""

from __future__ import annotations

import sympy

from gbspec.backends.module.equations import PARAMETERS, body_of, kept, state_with
from gbspec.backends.module.writing import comma, method_text
from gbspec.backends.printing import STATE, Assignment, Names, temporary
from gbspec.ir import Model


def methods(model: Model) -> list[str]:
    """`steady_states` and `steady`, in models that start in a steady state."""
    if model.steady is None:
        return []
    names = Names(PARAMETERS)
    given = (*model.conditions, *model.inputs)
    for item in (*given, *model.constants, *model.learnables):
        names.claim(item.symbol)
    held = {name: Assignment(temporary(f"held_{name}"), value, name) for name, value in model.steady.held}
    laws = [
        [Assignment(temporary(f"law{i}_{j}"), value, f"law{i}_{j}") for j, value in enumerate(law)]
        for i, law in enumerate(model.steady.laws)
    ]
    which = sympy.S.One if model.steady.chosen is None else model.steady.chosen
    chosen = Assignment(temporary("chosen"), which, "chosen")
    outputs = [*held.values(), *(one for law in laws for one in law), chosen]
    body = body_of(model, outputs, names, {item.symbol for item in given if item.name not in held})
    parts = []
    for word, items in (("condition", model.conditions), ("inputs", model.inputs)):
        found = comma(names[held[item.name].symbol if item.name in held else item.symbol] for item in items)
        parts.append(f"math.pack({word}, ({found}))" if any(item.name in held for item in items) else word)
    rows = (f"({comma(names[one.symbol] for one in law)})" for law in laws)
    body.append(f"return {parts[0]}, {parts[1]}, ({comma(rows)}), {names[chosen.symbol]}")
    document = "Conditions and inputs while a steady state is sought, sums of its states that stay, and whether it is."
    places = comma(str(i) for i in model.steady.states)
    return [
        f"# the states that start in a steady state\nsteady_states: ClassVar[tuple[int, ...]] = ({places})",
        method_text(
            "@staticmethod",
            "settled",
            ["slopes", "jacobians", "start", "laws"],
            "The steady states that are reached from starts, for functions of numpy.",
            ["return _settled(slopes, jacobians, start, laws)"],
        ),
        method_text("@classmethod", "steady", ["cls", "math", "condition", "inputs", "constants"], document, body),
        *_followed(model),
        *_resumed(model),
    ]


def _followed(model: Model) -> list[str]:
    """`followed`, where events lie on the way."""
    if not any(event.guard is not None for event in model.events):
        return []
    given = ["module", "start", "condition", "inputs", "constants"]
    document = (
        "A start [n] with its steady state in place of the declared one, and the failure if there is none; numpy."
    )
    return [method_text("@staticmethod", "followed", given, document, [f"return _followed_start({', '.join(given)})"])]


def _resumed(model: Model) -> list[str]:
    """`resumed`, where states are set after the steady state was found."""
    assert model.steady is not None
    if not model.steady.after:
        return []
    names = Names(PARAMETERS)
    for item in (*model.states, *model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    names.fix(STATE, "state")
    values = {
        model.states[place].name: Assignment(temporary(f"after_{place}"), value, model.states[place].name)
        for place, value in model.steady.after
    }
    body = body_of(model, list(values.values()), names, kept(model, values))
    body.append(f"return {state_with(model, {name: item.symbol for name, item in values.items()}, names)}")
    document = "The states with which a trajectory begins after its steady state was found."
    return [method_text("@classmethod", "resumed", ["cls", "math", "state", "condition", "constants"], document, body)]
