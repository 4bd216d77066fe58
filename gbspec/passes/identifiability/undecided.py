"""Why a question is left undecided: what was tried, and what would help."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from gbspec.ir import Expr, Model, in_language
from gbspec.passes.identifiability.question import Question
from gbspec.passes.terms import larger_than

MOST_STATES = 40
MOST_NODES = 50_000


class Why(Enum):
    """What ended the search for directions without an answer."""

    COMPENSATED = "free functions and starts still compensate made-up terms of the rates"
    ORDERS = "the answer still changes at the highest order"
    SIZE = "the expansion is too large"
    EFFORT = "the effort is spent"
    VALUES = "an expression has no finite value"
    ROUNDING = "what is left may be rounding, and numbers of more digits, which tell that, were not found"


@dataclass(frozen=True)
class Open:
    """A question without an answer, and the highest order that was looked at."""

    why: Why
    order: int


def unexamined(model: Model) -> str:
    """Why a model is not examined at all; empty where it is."""
    parts = [
        (model.events, "events"),
        (model.algebraics, "searched algebraic variables"),
        (model.delays, "delays"),
        (model.steady is not None, "a steady start"),
    ]
    if told := [what for present, what in parts if present]:  # thresholds, resets, solved equations, the past
        return f": models with {' and '.join(told)} are not examined{_AFTERWARDS}"
    if len(model.states) > MOST_STATES:
        return f": models of more than {MOST_STATES} states are not examined, and this one has {len(model.states)}"
    if not model.channels:
        return ": nothing is observed (`observe NAME`)"
    if larger_than(model, MOST_NODES):
        return f": formulas of more than {MOST_NODES} terms are not examined{_AFTERWARDS}"
    return ""


_AFTERWARDS = "; the intervals of a fit and `gbspec profile` say what its data leave open"


def no_numbers() -> str:
    """The reason where a calculation with the model's formulas fails."""
    return f": the expansion of its formulas has no finite numbers within the declared ranges{_AFTERWARDS}"


def beside_unmeasured(hidden: Sequence[str], sets: Sequence[Sequence[str]], clear: bool) -> str:
    """The reason of a model with random disturbances and unmeasured states; `sets` are those that the equations without
    disturbances do not tell apart, `clear` whether that is all that these leave open."""
    told = f": what random disturbances show beside {_list(hidden, 'and')}, which {'is' if len(hidden) == 1 else 'are'}"
    told += " not measured, is not examined"
    if sets:
        groups = "; nor ".join(
            f"{_list(names, 'and')} could not be {'told apart' if len(names) > 1 else 'learned'}" for names in sets
        )
        return f"{told}; without them {groups}{_AFTERWARDS}"
    return f"{told}; without them the learned constants of the equations could be told apart" if clear else told


def reason(question: Question, found: Open) -> str:
    """Why a question is open, in words."""
    told = "" if question.applications else "starts"
    functions = _list(list(dict.fromkeys(a.unknown for a in question.applications)), "and") or told
    if found.why is Why.VALUES:
        return (
            ": its formulas have no finite values at points within the declared ranges; ranges of states, conditions"
            " and inputs (`in [low, high]`) that leave out such points help"
        )
    if found.why is Why.COMPENSATED:
        if all(start is not None for start in question.starts) and not question.model.conditions:
            ways = f"{_differing(question)}, or make them depend on a `condition`"
            return (
                f": from a known start {functions} can follow any solution until it comes back to earlier arguments,"
                f" and what it shows then is not examined (an expansion in time, up to order {found.order});"
                f" starts that differ from trajectory to trajectory decide it: {ways}{_AFTERWARDS}"
            )
        what = f"up to order {found.order} of an expansion in time {functions} can still follow any solution"
    elif found.why is Why.ORDERS:
        what = f"the answer still changes at order {found.order} of an expansion in time, the highest that is tried"
    elif found.why is Why.ROUNDING:
        what = (
            f"what order {found.order} of an expansion in time leaves open may be rounding, and numbers of more digits,"
            " which would show that, were not found with the work that `check` does for one model"
        )
        return f": {what}{_AFTERWARDS}"
    else:
        states, learned = len(question.model.states), len(question.model.learnables)
        what = (
            f"an expansion in time beyond order {found.order} takes more work than `check` does for one model"
            f" ({states} state{'s' * (states != 1)}, {learned} learned constant{'s' * (learned != 1)})"
        )
    ways = _remedies(question)
    return f": {what}{'; it would help to ' + ways if ways else ''}{_AFTERWARDS}"


def _differing(question: Question) -> str:
    """What to write so that starts differ: a constant that is the start of a state gives way to that state."""
    model = question.model
    starts = {s: start for s, start in zip(model.states, question.starts, strict=True) if start is not None}
    for state, start in starts.items():
        learned = {k.symbol for k in model.learnables}
        others = {other: e for other, e in starts.items() if other is not state and start in e.free_symbols}
        if start in learned and others:
            lines = [
                f"initial {other.name} = {in_language(e.xreplace({start: state.symbol}), model.conditions)}"
                for other, e in others.items()
            ]
            return f"leave out `initial {state.name} = {start}` and write {_list(lines, 'and')}"
    return f"leave out {_list([f'initial {state.name} = …' for state in starts], 'or')}"


def _remedies(question: Question) -> str:
    """What makes a question smaller, or its answer show earlier."""
    seen = {part for e in question.outputs for part in _alone(question, e)}
    hidden = [question.model.states[i].name for i in question.hidden if i not in seen]
    several = [a.unknown for a in question.applications if len(a.arguments) > 1]
    ways = [f"observe {_list(hidden, 'or')}"] if hidden else []
    if several:
        ways.append(f"leave an argument out of {_list(list(dict.fromkeys(several)), 'or')}")
    return " or to ".join(ways)


def _alone(question: Question, output: Expr) -> set[int]:
    """The only state that a measured expression such as `log10(V)` depends on, without anything to be learned: it is
    as good as measured."""
    symbols = output.free_symbols - {constant.symbol for constant in question.model.constants}
    found = {i for i, state in enumerate(question.model.states) if state.symbol in symbols}
    return found if len(found) == len(symbols) == 1 else set()


def _list(names: Sequence[str], word: str) -> str:
    quoted = [f"`{name}`" for name in names]
    return ", ".join(quoted) if len(quoted) < 2 else ", ".join(quoted[:-1]) + f" {word} {quoted[-1]}"
