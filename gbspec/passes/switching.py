"""Where right-hand sides switch: the Model whose steps end there.

`if`, `max`, `min`, `abs` and `sign` of what changes continuously have a kink or a jump where the quantity that decides
passes zero. A step across it has the order 1 or 2, whatever its method. The Model here has such places as events
without effects, so that steps end at them; and its right-hand sides are held on one side of each while a part of a step
is taken (`gbspec.ir.Switch`), so that no Runge-Kutta stage sees the other one. Channels, resets and conditions of
events stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir import Event, Expr, Model, Switch, in_language, ordered, symbol
from gbspec.passes.continuity import jumping

MOST = 16
"""With more switches steps are not cut: each costs two more conditions in every sub-step."""
_ROUNDED = (sympy.floor, sympy.ceiling)
_KINDS = (sympy.Max, sympy.Min, sympy.Abs, sympy.sign, sympy.Piecewise, *_ROUNDED)
_ABOVE = (sympy.StrictGreaterThan, sympy.GreaterThan)
_BELOW = (sympy.StrictLessThan, sympy.LessThan)


@dataclass(frozen=True)
class Switched:
    """A Model whose steps end where its right-hand sides switch, None where that is not offered or there is nothing to
    cut at; then `reason` says why, and is empty if nothing switches. `skipped`: switches at which no step ends.

    `jumps`: whether a right-hand side may jump, not only have a kink, where steps end, or anywhere if there is a
    `reason` why none do. `skipped_jumps`: those of `skipped` at which it may jump. What moves the time of a jump moves
    the solution, which derivatives know only where steps end there.
    """

    model: Model | None
    reason: str = ""
    skipped: tuple[str, ...] = ()
    jumps: bool = False
    skipped_jumps: tuple[str, ...] = ()

    @property
    def unknown_jumps(self) -> str:
        """Why steps end not at all jumps of the right-hand sides, or at which they do not; empty if they do."""
        return (self.reason if self.jumps else "") or "; ".join(self.skipped_jumps)


def with_switches(model: Model) -> Switched:
    """The Model with the switches of its right-hand sides. Those that depend on the time, conditions and held inputs
    alone are no business of it: steps end there anyway, unless what is learned decides the time."""
    if not any(value.has(*_KINDS) for value in (*model.balances, *(item.value for item in model.intermediates))):
        return Switched(None)
    rewriting = _Rewriting(model)
    balances = rewriting.balances()
    skipped, jumps = tuple(rewriting.skipped), tuple(said for said, jumps in rewriting.skipped.items() if jumps)
    if not rewriting.switches:
        return Switched(None, "", skipped, False, jumps)
    reason = _refused(model, len(rewriting.switches))
    if reason:
        return Switched(None, reason, (), rewriting.jumps or bool(jumps))
    events = (*model.events, *(event for each in rewriting.switches for event in _events(each)))
    cut = replace(model, balances=balances, events=events, switches=tuple(rewriting.switches), claims=())
    return Switched(cut, "", skipped, rewriting.jumps, jumps)


def _events(switch: Switch) -> tuple[Event, Event]:
    """What happens where the guard becomes positive, and where it becomes negative."""
    name = in_language(switch.guard)
    return Event(f"{name} rises", guard=switch.guard), Event(f"{name} falls", guard=-switch.guard)


def _refused(model: Model, count: int) -> str:
    """Why steps of a model with `count` switches cannot be cut at these; empty if they can."""
    kinds = {
        "delays": model.delays,
        "algebraic variables": model.algebraics,
        "random disturbances": model.diffusions,
        "arrays of states": model.arrays,
        "a steady start": model.steady is not None,
    }
    found = next((name for name, there in kinds.items() if there), "")
    if found:
        return f"the model has {found}"
    return f"it has {count} of them, more than {MOST}" if count > MOST else ""


@dataclass
class _Rewriting:
    """The balances with their switches held; `_known` holds what was rewritten. `jumps`: whether a right-hand side may
    jump at one of the `switches`; of what is `skipped`, whether it may there."""

    model: Model
    switches: list[Switch] = field(default_factory=list)
    skipped: dict[str, bool] = field(default_factory=dict)
    jumps: bool = False
    _known: dict[sympy.Basic, sympy.Basic] = field(default_factory=dict)
    _sides: dict[Expr, sympy.Symbol] = field(default_factory=dict)

    def __post_init__(self) -> None:
        model = self.model
        moving = {state.symbol for state in model.states if not state.discrete}
        moving |= {item.symbol for item in model.algebraics} | {item.symbol for item in model.delays}
        self._moving = moving | {item.symbol for item in model.inputs if item.interpolation == "linear"}
        self._learned = {item.symbol for item in model.learnables}
        self._jumping = jumping(model)

    def balances(self) -> tuple[Expr, ...]:
        """All right-hand sides; intermediates that hold switches are written out in them, since channels and events see
        the others."""
        for item in self.model.intermediates:
            value = self._of(item.value)
            if value != item.value:
                self._known[item.symbol] = value
        return tuple(self._of(value) for value in self.model.balances)

    def _of(self, node: sympy.Basic) -> sympy.Basic:
        if node in self._known:
            return self._known[node]
        if not node.args:
            return node
        parts = ordered(node) if isinstance(node, sympy.Max | sympy.Min) else node.args
        self._known[node] = found = self._held(node, parts, [self._of(part) for part in parts])
        return found

    def _held(self, node: sympy.Basic, parts: Sequence[sympy.Basic], held: Sequence[sympy.Basic]) -> sympy.Basic:
        """A node from its parts and from what these are where they are held."""
        if isinstance(node, sympy.Max | sympy.Min):
            return self._extreme(node.func, parts, held)
        if isinstance(node, sympy.Abs) and (side := self._side(parts[0], held[0])) is not None:
            return _choice(held[0], side > 0, -held[0])
        if isinstance(node, sympy.sign) and (side := self._side(parts[0], held[0], jumps=True)) is not None:
            return _choice(1, side > 0, _choice(-1, side < 0, 0))
        if isinstance(node, _ABOVE + _BELOW):
            turn = 1 if isinstance(node, _ABOVE) else -1
            guard, other, jumps = turn * (parts[0] - parts[1]), turn * (held[0] - held[1]), node in self._jumping
            if (side := self._side(guard, other, jumps=jumps)) is not None:
                strict = isinstance(node, sympy.StrictGreaterThan | sympy.StrictLessThan)
                return (sympy.StrictGreaterThan if strict else sympy.GreaterThan)(side, 0, evaluate=False)
        if isinstance(node, _ROUNDED) and self._moves(self.model.inlined([parts[0]])[0]):
            self._skip(f"`{in_language(node)}` jumps", jumps=True)
        return node if tuple(held) == node.args else node.func(*held)

    def _extreme(
        self, function: type[sympy.Basic], parts: Sequence[sympy.Basic], held: Sequence[sympy.Basic]
    ) -> sympy.Basic:
        found, whole = held[0], parts[0]
        for part, other in zip(parts[1:], held[1:], strict=True):
            side = self._side(whole - part, found - other)
            whole = function(whole, part, evaluate=False)
            if side is None:
                found = function(found, other, evaluate=False)
            else:
                found = _choice(*((found, side > 0, other) if function is sympy.Max else (other, side > 0, found)))
        return found

    def _moves(self, inlined: Expr) -> bool:
        """Whether the place where a quantity passes zero changes with states or with what is learned."""
        free = inlined.free_symbols
        return bool(free & self._moving or (self.model.time.symbol in free and free & self._learned))

    def _skip(self, said: str, *, jumps: bool) -> None:
        self.skipped[said] = self.skipped.get(said, False) or jumps

    def _side(self, guard: Expr, held: Expr, *, jumps: bool = False) -> Expr | None:
        """What is positive on one side of the switch where `guard` passes zero (`held`: as it is where other switches
        are held), at which the value `jumps` or has a kink; None where no step is cut at it."""
        inlined = self.model.inlined([guard])[0]
        if not self._moves(inlined):
            return None
        unknown = inlined.atoms(AppliedUndef)
        if unknown or inlined.has(*_ROUNDED):
            reason = "an unknown function decides" if unknown else "`floor`, `ceil` or `mod` decides"
            self._skip(f"{reason} in `{in_language(guard)}`", jumps=jumps)
            return None
        self.jumps = self.jumps or jumps
        if -guard in self._sides:
            return held - self._sides[-guard]
        if guard not in self._sides:
            self._sides[guard] = symbol(f"side {len(self.switches) + 1}")  # no name of a file has a blank
            self.switches.append(Switch(self._sides[guard], guard))
        return held + self._sides[guard]


def _choice(value: sympy.Basic | int, condition: sympy.Basic, otherwise: sympy.Basic | int) -> sympy.Basic:
    return sympy.Piecewise((value, condition), (otherwise, True), evaluate=False)
