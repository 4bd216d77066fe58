"""The files of a model's C library: header, source, a program that simulates one trajectory, and a CMake file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import resources

from gbspec.backends import Flat, Leaf, table_function, table_functions
from gbspec.exports.c import networks
from gbspec.exports.c.delays import MARKS, delays, room
from gbspec.exports.c.names import OWN, CNames
from gbspec.exports.c.printer import ascii_text, distinct, helpers, number, table
from gbspec.exports.c.searching import searching
from gbspec.exports.c.straight import Place, Straight, function, unused
from gbspec.exports.programs import Programs
from gbspec.exports.subject import Exported

WHERE = "const {0}_parameters *p, double t, const double *x, const double *u"
ALONG = WHERE + ", const {0}_parameters *dp, double dt, const double *dx, const double *du"
ROUNDING = 1e-9
"""The share by which a trained range is wider here, so that a quantity that did not vary is not outside by rounding."""


class Library:
    """The C of an exported model. Raises NotCoveredError for what it cannot express."""

    def __init__(self, exported: Exported, programs: Programs | None = None) -> None:
        self.exported, self.model = exported, exported.model
        self.programs = programs or Programs(exported.model, events=True, algebraics=True)
        self.names = CNames(exported.model)
        self.prefix = self.names.prefix

    # -------------------------------------------------------------- header
    @property
    def sizes(self) -> dict[str, int]:
        """The lengths of all vectors."""
        model = self.model
        return {
            "STATES": len(model.states),
            "INPUTS": len(model.inputs),
            "DELAYS": len(model.delays),
            "CHANNELS": len(model.channels),
            "DOSES": len(model.doses),
            "FUNCTIONS": len(self.programs.applications),
            "ALGEBRAICS": len(model.algebraics),
            "SWITCHES": len(self.programs.switches.outputs),
            "NODES": len(self.exported.method.nodes),
            **({"MARKS": MARKS} if model.delays else {}),
            **({"GUARDS": len(self.programs.conditional), "TIMED": len(self.programs.timed)} if model.events else {}),
        }

    def header(self) -> str:
        """The header: what each function takes and gives."""
        model, p, upper = self.model, self.prefix, self.names.upper
        lines = [*self._opening(), f"#ifndef {upper}_H", f"#define {upper}_H", ""]
        lines += ["#ifdef __cplusplus", 'extern "C" {', "#endif", "", "/* The lengths of all vectors. */", "enum {"]
        lines += [f"    {upper}_{name} = {size}," for name, size in self.sizes.items()]
        lines[-1] = lines[-1].rstrip(",")
        lines += ["};", ""]
        for kind, names in self.names.indices(self.programs).items():
            if names:
                inside = ",\n".join(f"    {name} = {i}" for i, name in enumerate(names))
                lines += [f"/* Components: {kind.lower()}s. */", "enum {", *inside.splitlines(), "};", ""]
        given = (*model.conditions, *model.constants, *model.learnables)
        kinds = ["condition"] * len(model.conditions) + ["constant"] * len(model.constants)
        kinds += ["learned"] * len(model.learnables)
        lines += ["/* What is constant within a trajectory. */", "typedef struct {"]
        for member, item, kind in zip(self.names.parameters, given, kinds, strict=True):
            said = ", ".join(
                part for part in (kind, item.name, item.description, item.unit and f"[{item.unit}]") if part
            )
            lines.append(f"    double {member}; /* {ascii_text(said)} */")
        lines += ["    double unused; /* a struct needs a member */"] * (not given)
        lines += [f"}} {p}_parameters;", "", *(self._texts("past.h") if model.delays else []), *self._texts("header.h")]
        if model.algebraics:
            lines += self._texts("algebraic.h")
        if model.events:
            lines += self._texts("events.h")
        for name, arguments in self._unknowns():
            lines += [f"double {name}(const {p}_parameters *p, {arguments});", ""]
        return "\n".join([*lines, "#ifdef __cplusplus", "}", "#endif", "#endif", ""])

    def _opening(self) -> list[str]:
        model, origin = self.model, self.exported.origin
        lines = [f"/* {ascii_text(model.title or model.name)}", ""]
        lines += [f"   {key}: {ascii_text(value)}" for key, value in origin.items()]
        rows: tuple[tuple[str, Sequence[tuple[str, str]]], ...] = (
            (f"t, {model.time.name}", [(model.time.unit or "", model.time.description)]),
            *((f"x[{i}], {s.name}", [(s.unit or "", s.description)]) for i, s in enumerate(model.states)),
            *((f"u[{i}], {s.name}, {s.interpolation}", [(s.unit or "", "")]) for i, s in enumerate(model.inputs)),
            *((f"y[{i}], {s.name}", [(s.unit or "", s.description)]) for i, s in enumerate(model.channels)),
        )
        lines.append("")
        for name, ((unit, text),) in rows:
            said = f"{name}{f' [{unit}]' if unit else ''}{f': {text}' if text else ''}"
            lines.append(f"   {ascii_text(said)}")
        return [*lines, "*/", ""]

    # -------------------------------------------------------------- source
    def source(self) -> str:
        """The source of all functions."""
        model, programs = self.model, self.programs
        body: list[str] = list(networks.shared(model.networks))
        for i, (network, numbers) in enumerate(zip(model.networks, self.exported.networks, strict=True)):
            body += networks.network(i, network, numbers)
        body += self._defaults()
        body += searching(programs, self.prefix, self._place, self._direction, _text("search.c"))
        body += delays(programs, self.prefix, self._place, self._direction, _text("past.c"))
        body += self._initial()
        for name, flat in (("rhs", programs.rhs), ("observe", programs.observe), ("functions", programs.functions)):
            out = {"rhs": "dx", "observe": "y", "functions": "values"}[name]
            lines = self._straight(flat, out)
            head = f"void {self.prefix}_{name}({WHERE.format(self.prefix)}, double *{out})"
            body += function(head, lines, unused(["p", "t", "x", "u", out], lines))
            lines = self._straight(flat, "out", along=True)
            head = f"void {self.prefix}_{name}_along({ALONG.format(self.prefix)}, double *out)"
            body += function(head, lines, unused(["p", "t", "x", "u", "dp", "dt", "dx", "du", "out"], lines))
        body += [*self._outside(), *self._dose(), *self._events(), *self._called(), *self._step()]
        body += _text("guards.c").splitlines() if model.events else []
        body += self._part("simulate.c")
        text = "\n".join(body)
        text = self._sized(text)
        opening = [*self._opening(), f'#include "{self.prefix}.h"', "", "#include <math.h>", "#include <stddef.h>", ""]
        tables = [given for given in model.tables if f"{table_function(given.curve)}(" in text]
        return "\n".join([*opening, *helpers(text), *table_functions(tables), "", text, ""])

    def _texts(self, name: str) -> list[str]:
        """A text of the header, with the model's names."""
        return self._sized("\n".join(self._part(name))).splitlines()

    def _part(self, name: str) -> list[str]:
        """The lines of a text, without what is of parts that the model does not have."""
        parts = {"EVENTS": bool(self.model.events), "DELAYS": bool(self.model.delays)}
        past = f",\n{20 * ' '}{self.prefix}_past *past" if self.model.delays else ""
        text = _text(name).replace("PAST", past)
        if "ROOM" in text:
            text = text.replace("ROOM", str(room(self.exported, self.programs)))
        return _chosen(text, parts)

    def _sized(self, text: str) -> str:
        for size in (*self.sizes, "PIECES"):
            text = text.replace(f"PREFIX_{size}", f"{self.names.upper}_{size}")
        return text.replace("PREFIX", self.prefix)

    def _place(self, leaf: Leaf) -> str:
        match leaf.kind:
            case "state":
                return f"x[{leaf.index}]"
            case "input":
                return f"u[{leaf.index}]"
            case "delay":
                return f"u[{len(self.model.inputs) + leaf.index}]"
            case "condition":
                return f"p->{self.names.conditions[leaf.index]}"
            case "constant":
                return f"p->{self.names.constants[leaf.index]}"
            case "time":
                return "t"
            case "algebraic":
                return f"solved[{leaf.index}]"
        return number(self.exported.numbers[leaf.index])

    def _direction(self, leaf: Leaf) -> str:
        place = self._place(leaf)
        if leaf.kind == "time":
            return "dt"
        if leaf.kind == "algebraic":
            return f"d{place}"
        if place.startswith("p->"):
            return f"dp ? d{place} : 0.0"
        return f"d{place[0]} ? d{place} : 0.0"

    def _straight(self, flat: Flat, target: str, *, along: bool = False) -> list[str]:
        """A function's lines; they begin with the algebraic variables if it reads any."""
        lines, p = Straight(flat, self._place, self._direction if along else None).body(target), self.prefix
        if not any("solved[" in line for line in lines):
            return lines
        count = len(self.model.algebraics)
        first = [f"double solved[{count}]{f', dsolved[{count}]' if along else ''};"]
        first.append(f"{p}_algebraic(p, t, x, u, solved);")
        first += ["solved_along(p, t, x, u, solved, dp, dt, dx, du, dsolved);"] * along
        return [*first, *lines]

    def _defaults(self) -> list[str]:
        values = [*self.exported.conditions, *self.exported.constants]
        lines = [f"p->{m} = {number(v)};" for m, v in zip(self.names.parameters, values, strict=True)]
        lines += ["p->unused = 0.0;"] * (not lines)
        return function(f"void {self.prefix}_defaults({self.prefix}_parameters *p)", lines)

    def _initial(self) -> list[str]:
        """The initial values, their derivatives, and what decides the choices."""
        flat, count, p = self.programs.initial, len(self.model.states), self.prefix
        straight = Straight(flat, self._place).body("start")
        lines = [f"double start[{count}];", "int i;", *straight, f"for (i = 0; i < {count}; i++) x[i] = start[i];"]
        out = function(f"void {p}_initial(const {p}_parameters *p, double *x)", lines, unused(["p"], straight))
        lines = Straight(flat, self._place, self._direction).body("out")
        head = f"void {p}_initial_along(const {p}_parameters *p, const double *x, const {p}_parameters *dp, "
        out += function(head + "const double *dx, double *out)", lines, unused(["p", "x", "dp", "dx"], lines))
        lines = self._straight(self.programs.switches, "z")
        head = f"void {p}_switches({WHERE.format(p)}, double *z)"
        return out + function(head, lines, unused(["p", "t", "x", "u", "z"], lines))

    def _outside(self) -> list[str]:
        """Whether the arguments of each application lie in the range that its network learned from."""
        count = len(self.programs.arguments.outputs)
        lines = [f"double a[{max(count, 1)}];", "int any = 0, out;", *self._straight(self.programs.arguments, "a")]
        position = 0
        for i, item in enumerate(self.programs.applications):
            numbers = self.exported.networks[item.unknown.network]
            tests = []
            for low, high in zip(numbers.low, numbers.high, strict=True):
                margin = ROUNDING * (abs(low) + abs(high)) if math.isfinite(low) and math.isfinite(high) else 0.0
                tests += [f"!(a[{position}] >= {number(low - margin)})"] * math.isfinite(low)
                tests += [f"!(a[{position}] <= {number(high + margin)})"] * math.isfinite(high)
                position += 1
            lines += [f"out = {' || '.join(tests) or '0'};", f"if (which) which[{i}] = out;", "any = any || out;"]
        lines += ["(void)a;", "(void)out;", "return any;"]
        head = f"int {self.prefix}_outside({WHERE.format(self.prefix)}, int *which)"
        names = ["p", "t", "x", "u", "which"]
        return function(head, lines, unused(names, lines)) if count else function(head, ["return 0;"], names)

    def _dose(self) -> list[str]:
        flat = self.programs.doses
        lines = [f"double both[{max(len(flat.outputs), 1)}];", *Straight(flat, self._place).body("both")]
        for i in range(len(self.model.doses)):
            lines += [f"fraction[{i}] = both[{2 * i}];", f"lag[{i}] = both[{2 * i + 1}];"]
        head = f"void {self.prefix}_doses(const {self.prefix}_parameters *p, double *fraction, double *lag)"
        if not self.model.doses:
            return function(head, [], ["p", "fraction", "lag"])
        return function(head, lines, unused(["p"], lines))

    def _events(self) -> list[str]:
        """What events need, in models that have any."""
        if not self.model.events:
            return []
        programs, p, count = self.programs, self.prefix, len(self.model.states)
        out: list[str] = []
        for name, flat in (("guards", programs.guards), ("ranks", programs.ranks)):
            lines = self._straight(flat, "values")
            head = f"void {p}_{name}({WHERE.format(p)}, double *values)"
            out += function(head, lines, unused(["p", "t", "x", "u", "values"], lines))
        lines = Straight(programs.timing, self._place).body("values")
        out += function(
            f"void {p}_timing(const {p}_parameters *p, double *values)", lines, unused(["p", "values"], lines)
        )
        size = len(programs.happen.outputs)
        straight = self._straight(programs.happen, "after")
        lines = [f"double after[{size}];", "int i;", *straight]
        lines.append(f"for (i = 0; i < {count}; i++) found[i] = after[{count} * event + i];")
        head = f"void {p}_happen({WHERE.format(p)}, int event, double *found)"
        return out + function(head, lines, unused(["p", "t", "x", "u"], straight))

    def _unknowns(self) -> Iterator[tuple[str, str]]:
        """The C name and the parameters of each learned function."""
        names = distinct(
            (unknown.name for unknown in self.model.unknowns),
            {*OWN, *(f"{name}_along" for name in OWN)},
        )
        for name, unknown in zip(names, self.model.unknowns, strict=True):
            formals = [argument.name for argument in self.model.networks[unknown.network].arguments]
            listed = ", ".join(f"double {formal}" for formal in distinct(formals, ("p", "value")))
            yield f"{self.prefix}_{name}", listed

    def _called(self) -> list[str]:
        """Each learned function at given arguments."""
        lines: list[str] = []
        for (name, listed), unknown in zip(self._unknowns(), self.model.unknowns, strict=True):
            formals = [part.removeprefix("double ") for part in listed.split(", ")]
            body = Straight(self.programs.unknown(unknown), self._formal(formals)).body("value")
            head = f"double {name}(const {self.prefix}_parameters *p, {listed})"
            lines += function(head, ["double value[1];", *body, "return value[0];"], unused(["p", *formals], body))
        return lines

    def _formal(self, formals: Sequence[str]) -> Place:
        return lambda leaf: formals[leaf.index] if leaf.kind == "state" else self._place(leaf)

    # -------------------------------------------------------------- steps
    def _step(self) -> list[str]:
        method, model = self.exported.method, self.model
        stages = method.advancing
        rows = [number(float(a)) for row in method.a[:stages] for a in (*row, *[0] * (stages - len(row)))]
        lines = [*table("double", "A", rows), *table("double", "B", [number(float(b)) for b in method.b[:stages]])]
        lines += table("double", "C", [number(float(c)) for c in method.c[:stages]])
        lines += table("int", "AT", [str(method.nodes.index(c)) for c in method.c[:stages]])
        lines += table("double", "NODE", [number(float(c)) for c in method.nodes])
        linear = [str(int(item.interpolation == "linear")) for item in model.inputs] or ["0"]
        lines += table("int", "LINEAR", linear)
        places = [str(model.state_index[dose.state]) for dose in model.doses] or ["0"]
        lines += [
            *table("int", "DOSE_STATE", places),
            f"enum {{ STAGES = {stages}, WIDTH = {len(model.inputs) + len(model.delays)} }};",
            "",
        ]
        armed = [str(int(event.armed)) for event in self.programs.conditional] or ["0"]
        lines += table("int", "ARMED", armed) if model.events else []
        return [*lines, *self._part("step.c"), ""]


def _chosen(text: str, parts: Mapping[str, bool]) -> list[str]:
    """The lines of a text without those between `#if` and `#endif`, or `#else`, of parts that a model does not have."""
    kept, inside, foreign = list[str](), [True], 0
    for line in text.splitlines():
        word, _, part = line.partition(" ")
        foreign += word == "#ifndef"  # which stays in the text, with its end
        if word == "#if":
            inside.append(parts[part])
        elif word == "#else":
            inside[-1] = not inside[-1]
        elif word == "#endif" and not foreign:
            inside.pop()
        else:
            foreign -= word == "#endif"
            kept += [line] * all(inside)
    return kept


@cache
def _text(name: str) -> str:
    return resources.files("gbspec.exports.c").joinpath(name).read_text(encoding="utf-8")
