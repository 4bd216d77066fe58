"""The variables of a functional mock-up unit, with their value references and what each depends on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count

import sympy

from gbspec.exports.c import Library
from gbspec.ir import Condition, Constant, Learnable

REGIMEN = (
    ("amount", 0.0, "amount of each dose; 0: none"),
    ("first", None, "time of the first dose"),
    ("interval", 0.0, "time from one dose to the next"),
    ("number", 1.0, "number of doses"),
)
"""The parameters of the doses into a state."""


@dataclass(frozen=True)
class Variable:
    """A variable of the model description. `depends` and `initially` are value references that its value depends on, in
    general and at the start (None: it is known)."""

    name: str
    vr: int
    causality: str
    variability: str = "continuous"
    initial: str | None = None
    start: float | None = None
    unit: str | None = None
    description: str = ""
    derivative_of: int | None = None
    boolean: bool = False
    indicator: bool = False
    depends: tuple[int, ...] | None = None
    initially: tuple[int, ...] | None = None


class Variables:
    """All variables, in the order of their value references, which `core.h` defines."""

    def __init__(self, library: Library) -> None:
        self.library, self.exported, self.model = library, library.exported, library.model
        self.programs = library.programs
        sizes, model = library.sizes, library.model
        self.parameters = max(len(library.names.parameters), 1)
        self.first: dict[str, int] = {}
        place = 1
        for name, size in (
            ("state", sizes["STATES"]),
            ("derivative", sizes["STATES"]),
            ("input", sizes["INPUTS"]),
            ("parameter", self.parameters),
            ("regimen", 4 * sizes["DOSES"]),
            ("step", 1),
            ("channel", sizes["CHANNELS"]),
            ("function", sizes["FUNCTIONS"]),
            ("algebraic", sizes["ALGEBRAICS"]),
            ("switch", sizes["SWITCHES"]),
            ("guard", len(library.programs.conditional)),
            ("outside", 1),
        ):
            self.first[name] = place
            place += size
        self.symbols: dict[sympy.Symbol, int] = {model.time.symbol: 0}
        for kind, items in (("state", model.states), ("input", model.inputs), ("parameter", self._given)):
            self.symbols |= {item.symbol: self.first[kind] + i for i, item in enumerate(items)}

    @property
    def _given(self) -> tuple[Condition | Constant | Learnable, ...]:
        return (*self.model.conditions, *self.model.constants, *self.model.learnables)

    @cached_property
    def all(self) -> list[Variable]:
        """Every variable; equal names are told apart by an underscore."""
        found: list[Variable] = []
        taken: set[str] = set()
        for variable in self._variables():
            name = variable.name
            while name in taken:
                name += "_"
            taken.add(name)
            found.append(replace(variable, name=name))
        return found

    def _variables(self) -> Iterator[Variable]:
        model, time = self.model, self.model.time
        yield Variable(time.name, 0, "independent", unit=time.unit, description=time.description or "time")
        yield from self._states()
        for i, item in enumerate(model.inputs):
            vr, start = self.first["input"] + i, float(self.exported.inputs[i])
            yield Variable(item.name, vr, "input", start=start, unit=item.unit, description=item.description)
        yield from self._parameters()
        yield from self._channels()
        programs, functions = self.programs, self.programs.dependencies(self.programs.functions)
        for i, (application, on) in enumerate(zip(programs.applications, functions, strict=True)):
            unknown = application.unknown
            said = unknown.description or f"{application.node}"
            vr = self.first["function"] + i
            yield Variable(application.label, vr, "local", unit=unknown.unit, description=said, depends=self._refs(on))
        yield from self._algebraics()
        for i, on in enumerate(programs.dependencies(programs.switches)):
            value = str(self.programs.switched[i])
            vr, refs = self.first["switch"] + i, self._refs(on)
            yield Variable(
                f"switch[{i + 1}]", vr, "local", description=f"sign of {value}", indicator=True, depends=refs
            )
        for i, (event, on) in enumerate(zip(programs.conditional, programs.dependencies(programs.guards), strict=True)):
            vr, said = self.first["guard"] + i, event.description or f"{event.condition}"
            yield Variable(f"event.{event.name}", vr, "local", description=said, indicator=True, depends=self._refs(on))
        asked = set[sympy.Symbol]().union(*programs.dependencies(programs.arguments))
        yield Variable(
            "outside",
            self.first["outside"],
            "output",
            "discrete",
            "calculated",
            description="true where a learned function is asked outside of the ranges that it learned from",
            boolean=True,
            depends=self._refs(asked),
            initially=self._initially(asked),
        )

    def _states(self) -> Iterator[Variable]:
        model, measured = self.model, self._measured
        starts = self.programs.dependencies(self.programs.initial)
        for i, state in enumerate(model.states):
            vr = self.first["state"] + i
            causality = "output" if state.name in measured else "local"
            given = state.initial.value is not None
            yield Variable(
                state.name,
                vr,
                causality,
                initial="calculated" if given else "exact",
                start=None if given else float(self.exported.states[i]),
                unit=state.unit,
                description=state.description,
                depends=(vr,) if causality == "output" else None,
                initially=self._initially(starts[i]) if given else None,
            )
        for i, (state, on) in enumerate(zip(model.states, self.programs.dependencies(self.programs.rhs), strict=True)):
            yield Variable(
                f"der({state.name})",
                self.first["derivative"] + i,
                "local",
                unit=_rate(state.unit, model.time.unit),
                derivative_of=self.first["state"] + i,
                depends=self._refs(on),
                initially=self._initially(on),
            )

    def _algebraics(self) -> Iterator[Variable]:
        """Those that no output of the same name gives."""
        taken = {channel.name for channel in self.model.channels if str(channel.value) == channel.name}
        for i, item in enumerate(self.model.algebraics):
            if item.name not in taken:
                vr, on = self.first["algebraic"] + i, self._refs(self.programs.behind(item.symbol))
                yield Variable(item.name, vr, "local", unit=item.unit, description=item.description, depends=on)

    @property
    def _measured(self) -> set[str]:
        """States that are measured under their own names: their variables are outputs."""
        return {
            c.name for c in self.model.channels if c.state is not None and self.model.states[c.state].name == c.name
        }

    def _parameters(self) -> Iterator[Variable]:
        values = [*self.exported.conditions, *self.exported.constants]
        for i, (item, value) in enumerate(zip(self._given, values, strict=True)):
            yield Variable(
                item.name,
                self.first["parameter"] + i,
                "parameter",
                "tunable",
                "exact",
                start=float(value),
                unit=item.unit,
                description=item.description,
            )
        places = count(self.first["regimen"])
        states = {state.name: state for state in self.model.states}
        for dose in self.model.doses:
            units = (states[dose.state].unit, self.model.time.unit, self.model.time.unit, None)
            for (word, start, said), unit in zip(REGIMEN, units, strict=True):
                value = self.exported.start if start is None else start
                name = f"dose_{dose.state}.{word}"
                yield Variable(
                    name, next(places), "parameter", "tunable", "exact", start=value, unit=unit, description=said
                )
        yield Variable(
            "solver.step",
            self.first["step"],
            "parameter",
            "tunable",
            "exact",
            start=self.exported.step or 0.0,
            unit=self.model.time.unit,
            description="co-simulation: the largest step of the solver; 0: one step for each communication step",
        )

    def _channels(self) -> Iterator[Variable]:
        for i, (channel, on) in enumerate(
            zip(self.model.channels, self.programs.dependencies(self.programs.observe), strict=True)
        ):
            if channel.name in self._measured:
                continue
            yield Variable(
                channel.name,
                self.first["channel"] + i,
                "output",
                initial="calculated",
                unit=channel.unit,
                description=channel.description,
                depends=self._refs(on),
                initially=self._initially(on),
            )

    def _refs(self, symbols: Iterable[sympy.Symbol]) -> tuple[int, ...]:
        """The value references of states, inputs and time among symbols: what is known while time passes."""
        moving = {*range(self.first["derivative"]), *range(self.first["input"], self.first["parameter"])}
        late = {delay.symbol for delay in self.model.delays}  # which change with the time alone: the past is known
        refs = {0 if s in late else self.symbols[s] for s in symbols}
        return tuple(sorted(refs & moving))

    def _initially(self, symbols: Iterable[sympy.Symbol]) -> tuple[int, ...]:
        """The value references of what is known at the start: states that are calculated count by what they are of."""
        starts = self.programs.dependencies(self.programs.initial)
        found: set[sympy.Symbol] = set()
        for symbol in self.programs.before(symbols):
            index = self.model.state_index.get(symbol.name) if symbol in self._calculated else None
            found |= {symbol} if index is None else starts[index]
        return tuple(sorted(self.symbols[s] for s in found))

    @cached_property
    def _calculated(self) -> set[sympy.Symbol]:
        return {state.symbol for state in self.model.states if state.initial.value is not None}


def _rate(unit: str | None, time: str | None) -> str | None:
    """The unit of a derivative."""
    if unit is None or time is None:
        return None
    return f"{unit}/{time if time.isidentifier() else f'({time})'}"


def units(variables: Sequence[Variable]) -> list[str]:
    """The distinct units of variables."""
    return sorted({variable.unit for variable in variables if variable.unit})
