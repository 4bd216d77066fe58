"""Reports directions: the set of names, the transformation, the source lines, and remedies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Findings, Label, Span
from gbspec.ir import Model
from gbspec.passes.identifiability import remedies
from gbspec.passes.identifiability.branches import Branches
from gbspec.passes.identifiability.directions import MOST_COLUMNS, ORDERS, Directions, absorbers, at_order, find
from gbspec.passes.identifiability.generators import echelon
from gbspec.passes.identifiability.jets import size
from gbspec.passes.identifiability.question import Question, pose, pose_disturbed
from gbspec.passes.identifiability.series import Effort
from gbspec.passes.identifiability.symmetry import Symmetry, keeps_zeros, symmetries, transformations
from gbspec.passes.identifiability.undecided import Open, beside_unmeasured, no_numbers, reason, unexamined

_SAME_MISTAKE = frozenset({"GB403", "GB404"})
"""Earlier warnings on a constant that explain why it cannot be learned: never used, used only in comparisons."""

MOST_TRIED = 8
"""Of so many hidden states it is tried whether it helps to measure one of them."""

BUDGET = 1.2e8
"""Multiplications after which the answer is `undecided`: about two seconds."""


@dataclass(frozen=True)
class Inseparable:
    """Learnable constants and unknowns that no data can separate, and a transformation that proves it if known.

    `measured_states`: whether they are inseparable even with every state measured, or only with the declared channels.
    `states`: unmeasured states whose scale or origin only the unknowns fix, where no constant is concerned.
    """

    constants: tuple[str, ...]
    unknowns: tuple[str, ...]
    transformation: str
    measured_states: bool
    states: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of states, constants and unknowns."""
        return (*self.states, *self.constants, *self.unknowns)


@dataclass(frozen=True)
class Identifiability:
    """The answer; `decided` is False if time or size did not allow one, or if branches that data may show could add to
    what the others tell: `sets` is then only what holds in any case."""

    decided: bool
    sets: tuple[Inseparable, ...] = ()
    doubtful: tuple[str, ...] = ()
    """The constants that are not decided although the analysis came to its end: `faint` ones, and those for which such
    branches matter, or values that only changing inputs lead to."""
    faint: tuple[str, ...] = ()
    """The constants whose effects are too small beside others to be told from rounding."""
    branched: bool = False
    """Whether the model has branches."""
    reason: str = ""
    """Why the analysis did not come to its end, and what would help, as it follows "could not be decided"."""


def identifiability(model: Model, findings: Findings, budget: float = BUDGET) -> Identifiability:
    """Finds sets that no data can separate and records a warning for each (GB401; GB402 for a single constant; GB407
    for unmeasured states that only unknowns fix).

    Each unknown is a free function of its arguments; first with every state measured, then with what `observe` and
    `initial` declare. `allow GB401 NAME` with any name of a set accepts it.
    """
    if not model.learnables and not model.unknowns:
        return Identifiability(True)
    if told := unexamined(model):
        return Identifiability(False, reason=told)
    effort = Effort(budget)
    try:
        question = pose_disturbed(model) if model.diffusions else pose(model, all_states=False)
        everything = find(question if model.diffusions else pose(model, all_states=True), effort)
        declared = everything if model.diffusions else find(question, effort)
        hidden = _disturbed(model, effort) if model.diffusions else ""
    except (KeyError, np.linalg.LinAlgError, FloatingPointError):
        return Identifiability(False, reason=no_numbers())
    if isinstance(declared, Open):
        return Identifiability(False, reason=reason(question, declared))
    sets = [*_sets(question, declared, everything), *_free_states(question, effort)]
    reported, observed = {d.subject for d in findings if d.code in _SAME_MISTAKE}, _Observed(question, Effort(budget))
    for found in sets:
        if not any(name in reported or model.accepts("GB404", name) for name in found.constants):
            _warn(model, observed, found, findings)
    touched = np.max(np.abs(_relative(declared, declared.doubtful)), axis=1, initial=0.0) > 1e-6
    doubtful = tuple(k.name for k, moves in zip(question.sought, touched, strict=True) if moves)
    faint = tuple(name for name in doubtful if name in declared.faint)
    branched = bool(Branches(question).atoms)
    return Identifiability(not doubtful and not hidden, tuple(sets), doubtful, faint, branched, hidden)


def _disturbed(model: Model, effort: Effort) -> str:
    """Why a model with random disturbances is undecided: unmeasured states. Of these nothing but what all states would
    not show either is certain, as the size of a disturbance may tell what the equations leave open."""
    plain = pose(model, all_states=False)
    if not plain.hidden:
        return ""
    found = find(plain, effort)
    sets = [] if isinstance(found, Open) else [each.names for each in _sets(plain, found, None)]
    clear = isinstance(found, Directions) and not found.doubtful.shape[1]
    return beside_unmeasured([model.states[i].name for i in plain.hidden], sets, clear)


def by_one_trajectory(model: Model, budget: float = BUDGET) -> tuple[Inseparable, ...]:
    """Sets that a single trajectory cannot separate, in models whose unknowns are functions of time alone.

    Functions of states pass the same values more than once, which the expansion around one point does not see; a
    function of time does not, so that it can follow any single trajectory. Empty where that is not decided, with
    inputs and doses, whose jumps a smooth function does not follow, and for periodic functions, whose values return.
    """
    periodic = any(c.kind == "period" for unknown in model.unknowns for c in unknown.contracts)
    clock = frozenset({model.time.symbol})
    others = (model.events, model.algebraics, model.delays, model.diffusions, model.inputs, model.doses)
    if not model.unknowns or periodic or any(others) or model.steady is not None:
        return ()
    question = replace(pose(model, all_states=False), alone=True)
    of_time = [a for a in question.applications if {s for e in a.arguments for s in e.free_symbols} == clock]
    if len(of_time) < len(question.applications):
        return ()
    try:
        found = find(question, Effort(budget))
    except (KeyError, np.linalg.LinAlgError, FloatingPointError):
        return ()
    if isinstance(found, Open):
        return ()
    return tuple(each for each in _sets(question, found, None) if each.constants and each.unknowns)


def _sets(question: Question, declared: Directions, everything: Directions | Open | None) -> list[Inseparable]:
    names = [k.name for k in question.sought]
    known = symmetries(question, declared) if declared.basis.shape[1] else []
    sets: list[Inseparable] = []
    for group in _groups(_relative(declared, declared.basis)):
        members = [i for i in range(len(names)) if np.max(np.abs(group[i])) > 1e-6]
        constants = tuple(names[i] for i in members)
        natural = group * declared.sizes[:, None]
        unknowns = {u for direction in natural.T for u in absorbers(declared, direction)}
        constants += tuple(k.name for k in question.own if k.name in unknowns)
        ordered = tuple(u.name for u in question.model.unknowns if u.name in unknowns)
        proofs = [s for s in known if set(s.constants) <= set(constants)]
        measured = isinstance(everything, Directions) and _within(group, everything.basis / declared.sizes[:, None])
        sets.append(Inseparable(constants, ordered, _proof(proofs, group.shape[1]), measured))
    if isinstance(everything, Directions):
        sets += _loose(declared, everything, {name for s in sets for name in s.names})
    return sets


def _loose(declared: Directions, everything: Directions, told: set[str]) -> list[Inseparable]:
    """Functions, and constants of single trajectories, that can change while all shared constants stay."""
    functions = [name for name in declared.functions if name in everything.functions and name not in told]
    own = [name for name in declared.own if name in everything.own and name not in told]
    return [Inseparable(tuple(own), tuple(functions), "", True)] if len(functions) + len(own) > 1 else []


def _free_states(question: Question, effort: Effort) -> list[Inseparable]:
    """The unmeasured states that can be scaled or shifted together with unknowns alone, as at three orders in a row."""
    if not question.model.unknowns or all(question.starts[i] is not None for i in question.hidden):
        return []
    seen: list[dict[tuple[str, ...], list[Symmetry]]] = []
    for order in ORDERS[1:]:
        if size(question, order) > MOST_COLUMNS:
            return []
        directions = at_order(question, order, effort)
        if directions is None:
            return []
        groups: dict[tuple[str, ...], list[Symmetry]] = {}
        for one in transformations(question, directions):
            if one.states and not one.constants and keeps_zeros(question, one):
                groups.setdefault(tuple(sorted(one.states)), []).append(one)
        seen.append(groups)
        if len(seen) > 1 and not seen[-1] and not seen[-2]:
            return []
        if len(seen) > 2 and seen[-1] == seen[-2] == seen[-3]:
            order_of = [state.name for state in question.model.states]
            return [_free(states, proofs, order_of) for states, proofs in groups.items()]
    return []


def _free(states: Sequence[str], proofs: Sequence[Symmetry], order: Sequence[str]) -> Inseparable:
    unknowns = tuple(dict.fromkeys(name for one in proofs for name in one.unknowns))
    ordered = tuple(sorted(states, key=order.index))
    return Inseparable((), unknowns, _proof(proofs, len(proofs)), False, ordered)


def _proof(proofs: Sequence[Symmetry], count: int) -> str:
    return "; ".join(str(s) for s in proofs[:count])


def _relative(directions: Directions, basis: Array) -> Array:
    """Directions in units of the constants' sizes, of length 1: which constants they move does not depend on units."""
    found = basis / directions.sizes[:, None] if basis.shape[1] else basis
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=0), 1e-300))


def _groups(basis: Array) -> list[Array]:
    """Directions that share constants, together; rows are constants."""
    rows = echelon(basis.T) if basis.shape[1] else np.zeros((0, basis.shape[0]))
    groups: list[tuple[set[int], list[int]]] = []
    for k, row in enumerate(rows):
        support = {int(i) for i in np.flatnonzero(np.abs(row) > 1e-6)}
        touching = [g for g in groups if g[0] & support]
        groups = [g for g in groups if not g[0] & support]
        groups.append((support.union(*(g[0] for g in touching)), [k, *(i for g in touching for i in g[1])]))
    return [rows[sorted(members)].T for _, members in groups]


def _within(group: Array, basis: Array) -> bool:
    """Whether all directions of a group are combinations of those of a basis."""
    if not basis.shape[1]:
        return False
    rest = group - basis @ np.linalg.lstsq(basis, group, rcond=None)[0]
    return bool(np.max(np.abs(rest)) < 1e-6 * np.max(np.abs(group)))


# -------------------------------------------------------------------------------------------------------- reporting


@dataclass
class _Observed:
    """What remains of a question's sets where some of its hidden states are measured too, within an effort."""

    question: Question
    effort: Effort
    _rest: dict[tuple[int, ...], list[Inseparable] | None] = field(default_factory=dict)

    def rest(self, *states: int) -> list[Inseparable] | None:
        """The sets with these states measured; None where that is not decided."""
        if states not in self._rest:
            try:
                self._rest[states] = self._found(replace(self.question, known=self.question.known | set(states)))
            except (KeyError, np.linalg.LinAlgError, FloatingPointError):
                self._rest[states] = None
        return self._rest[states]

    def _found(self, question: Question) -> list[Inseparable] | None:
        found = find(question, self.effort)
        if isinstance(found, Open) or found.doubtful.shape[1]:
            return None
        return [*_sets(question, found, None), *_free_states(question, self.effort)]

    def ways(self, found: Inseparable) -> list[str]:
        """What to observe so that a set can be learned: one of the states each of which is enough, else all of them
        where that is; where that is not decided, what may help."""
        states, hidden = self.question.model.states, self.question.hidden
        if found.measured_states or not hidden:
            return []
        names = [states[i].name for i in hidden]
        if len(hidden) <= MOST_TRIED:
            each = [self.rest(i) for i in hidden]
            helps = [name for name, sets in zip(names, each, strict=True) if sets is not None and _gone(found, sets)]
            if helps:
                return [f"observe {_list(helps, 'or')}"]
            together = self.rest(*hidden)
            if together is not None and None not in each:
                return [f"observe {_list(names)}"] if _gone(found, together) else []
        return [f"observe {_list(names, 'or')}, which may help"]


def _gone(found: Inseparable, sets: Sequence[Inseparable]) -> bool:
    """Whether nothing of a set is among those that remain."""
    mine = set(found.constants or found.states)
    return not any(mine & set(one.constants or one.states) for one in sets)


def _warn(model: Model, observed: _Observed, found: Inseparable, findings: Findings) -> None:
    code = "GB407" if found.states else "GB401" if len(found.names) > 1 else "GB402"
    if any(model.accepts(code, name) for name in found.names):
        return
    spans = {item.name: item.span for item in (*model.states, *model.learnables, *model.unknowns)}
    by = "any data" if found.measured_states else "what is observed"
    if code == "GB407":
        message = f"{_free_part(found)} of {_list(found.states)} cannot be learned from {by}"
    elif code == "GB402":
        message = f"`{found.names[0]}` cannot be learned from {by}"
    else:
        message = f"{_list(found.names)} cannot be told apart by {by}"
    others = [*((n, "state") for n in found.states), *((n, "learnable constant") for n in found.constants)]
    others += [(n, "unknown function") for n in found.unknowns]
    (_, kind), *others = others
    place: Span | None = spans.get(found.names[0])
    told = {spans[name]: text for name, text in others if spans.get(name) not in (None, place)}  # each place once
    labels = [Label(span, text) for span, text in told.items() if span is not None]
    findings.warning(
        code,
        message,
        place,
        label=kind,
        labels=labels,
        notes=[_note(found), *_scope(observed.question)],
        help=_help(model, observed, found, code),
        subject=found.names[0],
    )


def _free_part(found: Inseparable) -> str:
    """What no data fix of unmeasured states, by the transformations of these states."""
    first = found.transformation.split("; ")
    shifted = [any(f"{name} -> {name} {sign}" in text for name in found.states for sign in "+-") for text in first]
    return "the scale and the origin" if len(set(shifted)) > 1 else "the origin" if shifted[0] else "the scale"


def _note(found: Inseparable) -> str:
    if found.states:
        return (
            f"{found.transformation} leaves everything that is observed unchanged; a fit shows one of these solutions"
        )
    if found.transformation:
        return f"{found.transformation} leaves everything that is observed unchanged"
    if not found.constants:
        return "a change of one of them can compensate a change of the other"
    if found.unknowns:
        return f"{_list(found.unknowns)} can compensate any change of {_list(found.constants)}"
    if len(found.constants) == 1:
        return "no observed quantity depends on it"
    return "they can change together without any effect on what is observed"


def _scope(question: Question) -> list[str]:
    """What the answer depends on where there are branches."""
    model = question.model
    ranges = (*(s.range for s in model.states), *(c.range for c in model.conditions), *(i.range for i in model.inputs))
    if not Branches(question).atoms or ranges.count(None) == len(ranges):
        return []
    return ["this holds for values within the declared ranges: other branches of the equations were not considered"]


def _help(model: Model, observed: _Observed, found: Inseparable, code: str) -> str:
    ways: list[str] = []
    if found.states:
        ways.append(f"give {_list(found.states, 'or')} a known start (`initial {found.states[0]} = …`)")
    ways += observed.ways(found)
    if found.constants:
        ways += remedies.ways(model, found.constants)
    if found.unknowns and found.measured_states:
        ways.append(f"leave an argument out of {_list(found.unknowns, 'or')}")
    return f"{'; or '.join(ways)}; or accept it with `allow {code} {found.names[0]}`"


def _list(names: Sequence[str], word: str = "and") -> str:
    quoted = [f"`{name}`" for name in names]
    return quoted[0] if len(quoted) == 1 else ", ".join(quoted[:-1]) + f" {word} {quoted[-1]}"
