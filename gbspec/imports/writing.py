"""The text of a description: a `.gb` file that a person can read."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from gbspec.imports.description import Channel, Conversion, Description, Event, Quantity, Rest
from gbspec.imports.formulas import ONE, ZERO, Formula, condition_text, names, text, walk
from gbspec.syntax import REFUSED, is_name

_WORDS = """
    model time unit state condition input const learn let function unknown process initial observe dose diffusion
    conserve truth effect correlate allow without algebraic equation event discrete delay history table steady
    held linear noise rate prior per from in as by extends times lag trajectory then when
"""
KEYWORDS = frozenset(_WORDS.split())
"""Words of the grammar; no quantity is named like one, though most could be."""
_COLUMNS = re.compile(r"(sd|dose|rate|dur|ii|addl|ss|limit)_|(trajectory|name|value|sd)$")


class Spelling:
    """The names of a file: each as in the source, if the language allows it, else with underscores after it."""

    def __init__(self, taken: Iterable[str]) -> None:
        self._found: dict[str, str] = {}
        self._taken = set(taken)

    def __call__(self, name: str) -> str:
        """The spelling of a name of the source."""
        if name not in self._found:
            made = name if is_name(name) else re.sub(r"\W", "_", f"_{name}" if name[:1].isdigit() else name) or "_"
            if made in KEYWORDS or made in REFUSED:
                made += "_"
            self._found[name] = self.free(made) if made != name else name
            self._taken.add(self._found[name])
        return self._found[name]

    def free(self, name: str) -> str:
        """A name that nothing has: this one, or with underscores after it."""
        while name in self._taken:
            name += "_"
        return name


@dataclass
class Written:
    """The text of a model, and the column of each channel."""

    text: str
    columns: dict[str, str] = field(default_factory=dict)


def written(description: Description, units: bool = True) -> Written:
    """The text of a description, with its units or without them."""
    return _Writer(description, units).written()


class _Writer:
    def __init__(self, description: Description, units: bool) -> None:
        self.made, self.units = description, units
        declared = {*_declared(description)}
        self.spelled = Spelling(declared)
        for name in sorted(declared):
            self.spelled(name)
        used = {self.spelled(name) for name in declared} | set(_formals(description))
        self.time = next(name for name in ("t", "time_", "clock_time", "t__") if name not in used)
        self.spelled._taken.add(self.time)
        self.columns: dict[str, str] = {}

    def written(self) -> Written:
        """All sections, with an empty line between them."""
        made = self.made
        sections = [
            self._head(),
            [self._quantity(q) for q in made.constants],
            [self._function(f.id, f.arguments, f.value, f.description) for f in made.functions],
            [self._state(q) for q in made.states],
            [self._let(q) for q in made.intermediates],
            [self._process(c) for c in made.conversions],
            [self._balance(name, value) for name, value in made.balances.items()],
            [self._initial(q) for q in made.states if q.value is not None and not q.discrete],
            [] if made.rest is None else [self._rest(made.rest)],
            [self._event(e) for e in made.events],
            [self._channel(c) for c in made.channels],
        ]
        text = "\n\n".join("\n".join(lines) for lines in sections if lines) + "\n"
        return Written(text, self.columns)

    def _head(self) -> list[str]:
        title = f' "{quoted(self.made.title)}"' if self.made.title else ""
        unit = f" : {self.made.time_unit}" if self.units and self.made.time_unit else ""
        lines = [f"model {self.made.name}{title}"]
        if self.made.source:
            lines.append(f"# imported from {quoted(self.made.source)} by gbspec import")
        lines.append(f"time {self.time}{unit} from 0")
        if self.units:
            declared = [q.unit or "" for q in (*self.made.constants, *self.made.states, *self.made.intermediates)]
            words = set(re.findall(r"\w+", " ".join([*declared, self.made.time_unit or ""])))
            lines += [f'unit {name} "{quoted(said)}"' for name, said in self.made.units.items() if name in words]
        return lines

    def _said(self, description: str) -> str:
        return f' "{quoted(description)}"' if description else ""

    def _unit(self, quantity: Quantity) -> str:
        return f" : {quantity.unit}" if self.units and quantity.unit else ""

    def _text(self, formula: Formula) -> str:
        return text(formula, self.spelled, self.time)

    def _quantity(self, one: Quantity) -> str:
        value = f" = {self._text(one.value)}" if one.value is not None else ""
        keyword = "condition" if one.condition else "const" if one.learn is None else "learn"
        clauses = f" {one.learn}" if one.learn else ""
        if one.condition and self.spelled(one.id) != one.id:  # the table has the name of the source
            clauses += f' as "{quoted(one.id)}"'
        return f"{keyword} {self.spelled(one.id)}{self._unit(one)}{value}{clauses}{self._said(one.description)}"

    def _function(self, name: str, arguments: tuple[str, ...], value: Formula, description: str) -> str:
        own = {argument: argument + "_" * (argument in KEYWORDS or argument in REFUSED) for argument in arguments}
        body = text(value, lambda n: own.get(n) or self.spelled(n), self.time)
        return f"function {self.spelled(name)}({', '.join(own.values())}) = {body}{self._said(description)}"

    def _state(self, one: Quantity) -> str:
        if one.discrete and one.value is not None:
            value = self._text(one.value)
            return f"discrete {self.spelled(one.id)}{self._unit(one)} = {value}{self._said(one.description)}"
        return f"state {self.spelled(one.id)}{self._unit(one)}{self._said(one.description)}"

    def _let(self, one: Quantity) -> str:
        assert one.value is not None
        return f"let {self.spelled(one.id)}{self._unit(one)} = {self._text(one.value)}{self._said(one.description)}"

    def _process(self, one: Conversion) -> str:
        sides = f"{self._side(one.consumed)} -> {self._side(one.produced)}".strip()
        rate = self._text(one.rate)
        return f"process {self.spelled(one.id)}: {sides} rate {rate}{self._said(one.description)}"

    def _side(self, terms: tuple[tuple[Formula, str], ...]) -> str:
        return " + ".join(
            self.spelled(state) if factor == ONE else f"{self._factor(factor)}*{self.spelled(state)}"
            for factor, state in terms
        )

    def _factor(self, formula: Formula) -> str:
        found = self._text(formula)
        return found if formula.head in ("number", "name", "/", "*") else f"({found})"

    def _balance(self, name: str, value: Formula) -> str:
        converted = any(name == state for c in self.made.conversions for _, state in (*c.consumed, *c.produced))
        state = self.spelled(name)
        right = self._text(value)
        if converted:
            right = f"net({state}) + {right}" if right != "0" else f"net({state})"
        return f"{state}' = {right}"

    def _initial(self, one: Quantity) -> str:
        assert one.value is not None
        return f"initial {self.spelled(one.id)} = {self._text(one.value)}"

    def _rest(self, one: Rest) -> str:
        clauses = [
            f" {word} " + ", ".join(f"{self.spelled(name)} = {self._text(value)}" for name, value in pairs)
            for word, pairs in (("with", one.held), ("then", one.after))
            if pairs
        ]
        when = "" if one.when is None else f" when {condition_text(one.when, self.spelled, self.time)}"
        return f"initial steady{''.join(clauses)}{when}"

    def _event(self, one: Event) -> str:
        condition = condition_text(one.condition, self.spelled, self.time)
        clauses = [f"after {self._text(one.after)}"] if one.after is not None else []
        clauses += [f"queue {one.queue}"] if one.queue > 1 else []
        clauses += [f"priority {self._text(one.priority)}"] if one.priority != ZERO else []
        flags = {"transient": one.transient, "sampled": one.sampled, "armed": one.armed}
        clauses += [word for word, said in flags.items() if said]
        how = "".join(f" {clause}" for clause in clauses)
        values = ", ".join(f"{self.spelled(state)} = {self._text(value)}" for state, value in one.values)
        when = f"when {condition}"
        if one.at is not None and one.after is None and not any(flags.values()):
            when = f"at {self._text(one.at)}"
        return f"event {self.spelled(one.id)} {when}{how}: {values}{self._said(one.description)}"

    def _channel(self, one: Channel) -> str:
        column = one.column + "_" * bool(_COLUMNS.match(one.column))
        self.columns[one.id] = column
        noise = f" noise {one.noise[0]}({self._text(one.noise[1])})" if one.noise else ""
        plain = one.value.head == "name" and one.value.name in {
            q.id for q in (*self.made.states, *self.made.intermediates)
        }
        if plain and one.id == one.value.name:
            name, value = self.spelled(one.id), ""
        else:
            taken = one.id in {*_declared(self.made, channels=False)}
            name = self.spelled.free(f"{self.spelled(one.id)}_value") if taken else self.spelled(one.id)
            value = f" = {self._text(one.value)}"
        as_ = f' as "{quoted(column)}"' if column != name else ""
        return f"observe {name}{value}{noise}{as_}"


def _declared(made: Description, channels: bool = True) -> Iterable[str]:
    for part in (made.constants, made.states, made.intermediates, made.functions, made.conversions, made.events):
        yield from (one.id for one in part)
    if channels:
        yield from (one.id for one in made.channels)


def _formals(made: Description) -> Iterable[str]:
    for one in made.functions:
        yield from one.arguments


def quoted(said: str) -> str:
    """A text as it may stand in quotes: one line, without quotes and signs that cannot be printed."""
    line = " ".join(said.replace('"', "'").split())
    return "".join(c for c in line if c.isprintable())[:200]


def model_name(name: str) -> str:
    """A model's name from that of a file or an element."""
    made = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_") or "imported"
    made = f"model_{made}" if made[0].isdigit() else made
    return made + "_" * (made in KEYWORDS or made in REFUSED)


def used_names(made: Description) -> set[str]:
    """All names in the formulas of a description."""
    found: set[str] = set()
    for formula in _formulas(made):
        found |= names(formula)
        found |= {node.name for node in walk(formula) if node.head == "apply"}
    return found


def _formulas(made: Description) -> Iterable[Formula]:
    for part in (made.constants, made.states, made.intermediates, made.functions, made.channels):
        yield from (one.value for one in part if one.value is not None)
    yield from (channel.noise[1] for channel in made.channels if channel.noise is not None)
    for conversion in made.conversions:
        yield conversion.rate
        yield from (factor for factor, _ in (*conversion.consumed, *conversion.produced))
    yield from made.balances.values()
    if made.rest is not None:
        yield from (value for _, value in (*made.rest.held, *made.rest.after))
        if made.rest.when is not None:
            yield made.rest.when
    for event in made.events:
        yield from (event.condition, event.priority, *(value for _, value in event.values))
        if event.after is not None:
            yield event.after
