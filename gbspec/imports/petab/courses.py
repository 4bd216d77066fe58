"""Experiments of PEtab 2 in which something changes after the start: as events, whose times are conditions."""

from __future__ import annotations

import math
from collections.abc import Callable

from gbspec.imports.description import Description, Quantity
from gbspec.imports.formulas import TIME, ZERO, Formula, chosen, compared, named, number, spelled_number, walk
from gbspec.imports.petab.problem import Row
from gbspec.imports.petab.second import Second, Switch
from gbspec.imports.sbml import Happening

Parse = Callable[[str, str, Row], Formula | None]
"""The formula of a text; what has it, and where, for a refusal."""


class Courses:
    """The changes of all experiments; the first ones of all are one event, the second ones another."""

    def __init__(self, second: Second, values: dict[str, dict[str, str]], experiment: str, parse: Parse) -> None:
        self._values, self._experiment = values, experiment
        self._starts = {name: start if math.isfinite(start) else 0.0 for name, start in second.starts.items()}
        self._orders: dict[str, list[Switch]] = {}
        self._formulas: dict[str, dict[str, Formula]] = {}
        for one in second.switches:
            if one.experiment in values:
                self._orders.setdefault(one.experiment, []).append(one)
                what = f"condition at {one.time:g}"
                found = {k: parse(text, what, one.row) for k, text in one.values.items()}
                self._formulas[_name(one)] = {k: v for k, v in found.items() if v is not None}

    def at(self, experiment: str, time: float | None) -> str:
        """The name of the change at a time; empty without one."""
        return next((_name(one) for one in self._orders.get(experiment, ()) if one.time == time), "")

    def values_at(self, name: str) -> dict[str, Formula]:
        """What a change sets."""
        return self._formulas[name]

    def happenings(self, constants: dict[str, Quantity]) -> tuple[Happening, ...]:
        """The events; their times become conditions among the constants."""
        made = []
        never = 1 + 2 * max((abs(one.time) for order in self._orders.values() for one in order), default=0.0)
        for number_of in range(max(map(len, self._orders.values()), default=0)):
            name = f"switch_{number_of + 1}"
            time = f"{name}_time"
            constants[time] = Quantity(time, None, "when the experiment changes", condition=True)
            mine = {e: order[number_of] for e, order in self._orders.items() if number_of < len(order)}
            for experiment, row in self._values.items():
                one = mine.get(experiment)
                row[time] = spelled_number(never if one is None else one.time - self._starts[experiment])
            targets = dict.fromkeys(k for one in mine.values() for k in self._formulas[_name(one)])
            values = {target: self._value(target, mine, constants) for target in targets}
            condition = Formula(">=", (TIME, named(time)))
            made.append(Happening(name, condition, values, ZERO, ZERO, False, False, True, True, _NOWHERE, named(time)))
        return tuple(made)

    def _value(self, target: str, mine: dict[str, Switch], constants: dict[str, Quantity]) -> Formula:
        """What an event sets a quantity to: each experiment its own, and those without a change what it is."""
        found = named(target)
        if mine.keys() != self._values.keys() or len(mine) > 1:
            number_of = Quantity(self._experiment, None, "number of the condition", condition=True)
            constants.setdefault(self._experiment, number_of)
            for experiment, one in mine.items():
                here = compared(
                    "==", named(self._experiment), number(float(self._values[experiment][self._experiment]))
                )
                found = chosen(here, self._formulas[_name(one)].get(target, named(target)), found)
            return found
        return self._formulas[_name(next(iter(mine.values())))][target]


def _name(one: Switch) -> str:
    return f"{one.experiment} at {one.time!r}"


class _Nowhere:
    """The element of an event that the model does not have."""

    def getLine(self) -> int:  # noqa: N802 - as libsbml calls it
        return 0

    def getId(self) -> str:  # noqa: N802 - as libsbml calls it
        return ""

    def getName(self) -> str:  # noqa: N802 - as libsbml calls it
        return ""


_NOWHERE = _Nowhere()


def uses_time(made: Description) -> bool:
    """Whether the time itself, and not only what passed of it, changes the solutions of a model."""
    formulas = [q.value for part in (made.intermediates, made.states, made.functions) for q in part]
    formulas += [c.rate for c in made.conversions] + list(made.balances.values()) + [c.value for c in made.channels]
    formulas += [e.condition for e in made.events if not e.id.startswith("switch_")]
    return any(node.head == "time" for formula in formulas if formula is not None for node in walk(formula))
