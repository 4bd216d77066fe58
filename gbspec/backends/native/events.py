"""The events of a model in the kernel: conditions, times and resets as C, forward and in reverse."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import sympy

from gbspec.backends.native.flat import Flat, Leaf, NotCoveredError, flatten
from gbspec.backends.native.sections import Equations
from gbspec.ir import Event, Expr, Model

_PLACES = "const real *restrict x, const real *restrict time, const real *restrict inputs"
_BACK = "const real *restrict ob, real *restrict xb, double *restrict kb, real *restrict tb, real *restrict ub"
_UNUSED = "(void)w; (void)block; (void)x; (void)time; (void)inputs;"
_UNUSED_BACK = "(void)ob; (void)xb; (void)kb; (void)tb; (void)ub;"

Place = Callable[[Leaf], str]


def check(model: Model, precision: str) -> None:
    """Raises NotCoveredError for what the kernel does not offer together with events."""
    if not model.events:
        return
    if precision != "float64":
        raise NotCoveredError("it has events, whose times need double precision")


def sizes(model: Model) -> dict[str, int]:
    """The sizes that `events.c` uses."""
    ranked = any(event.rank is not None for event in model.events)
    sizes = {"EVENTS": len(model.events), "TIMED_EVENTS": len(_timed(model)), "RANKED": int(ranked)}
    return sizes | {"SWITCHES": len(model.switches)}


def _timed(model: Model) -> list[Event]:
    return [event for event in model.events if event.timing is not None]


def functions(model: Model, place: Place) -> list[str]:
    """The functions of the model's events that `events.c` calls; none in models without."""
    if not model.events:
        return []
    guards = [event.guard for event in model.events if event.guard is not None]
    lines = [f"static const int ARMED[] = {{{_numbers(e.armed for e in model.events if e.timing is None)}}};"]
    lines += _both("guards", _equations(model, guards, place, "the condition of an event"))
    if any(event.rank is not None for event in model.events):
        ranks = [sympy.Float(e.priority) if e.rank is None else e.rank for e in model.events]
        lines += _forward("ranks", _equations(model, ranks, place, "the priority of an event"))
    return [*lines, *_happen(model, place), *_timing(model, place)]


def _numbers(values: Iterable[bool]) -> str:
    return ", ".join(str(int(value)) for value in values) or "0"


def _equations(model: Model, outputs: Sequence[Expr], place: Place, what: str) -> Equations:
    """Equations without networks. Raises NotCoveredError for an unknown function in them."""
    flat: Flat = flatten(model, outputs)
    if flat.calls:
        raise NotCoveredError(f"an unknown function stands in {what}")
    return Equations(model, flat, 0, place, "event", timed=True)


def _both(name: str, equations: Equations) -> list[str]:
    head = f"static void {name}_reverse(Work *w, size_t block, {_PLACES}, {_BACK}) {{"
    return [*_forward(name, equations), head, f"    {_UNUSED} {_UNUSED_BACK}", *equations.reverse(), "}", ""]


def _forward(name: str, equations: Equations) -> list[str]:
    head = f"static void {name}_forward(Work *w, size_t block, {_PLACES}, real *restrict out) {{"
    return [head, f"    {_UNUSED} (void)out;", *equations.forward(), "}", ""]


def _happen(model: Model, place: Place) -> list[str]:
    """What each event does with the whole state."""
    lines = []
    for i, event in enumerate(model.events):
        values = dict(event.values)
        outputs = [values.get(state.name, state.symbol) for state in model.states]
        lines += _both(f"happen{i}", _equations(model, outputs, place, "what an event sets"))
    for way, more in (("forward", "real *restrict out"), ("reverse", _BACK)):
        given = "out" if way == "forward" else "ob, xb, kb, tb, ub"
        lines += [
            f"static void happen_{way}(Work *w, int event, {_PLACES}, {more}) {{",
            "    switch (event) {",
            *(
                f"    case {i}: happen{i}_{way}(w, 0, x, time, inputs, {given}); break;"
                for i in range(len(model.events))
            ),
            "    }",
            "}",
            "",
        ]
    return lines


def _timing(model: Model, place: Place) -> list[str]:
    """First time, interval and last time of each timed event, and the cotangents of the constants in its times."""
    timings = [event.timing for event in _timed(model) if event.timing is not None]
    parts = [(timing.at, timing.every, timing.until) for timing in timings]
    has = ", ".join("{" + _numbers(part is not None for part in three) + "}" for three in parts)
    outputs = [sympy.S.Zero if part is None else part for three in parts for part in three]
    back = [
        "static void timing_reverse(Work *w, int event, double bar, double turn, double *kb) {",
        f"    real ob[3 * {max(1, len(parts))}] = {{0}}, xb[STATES], tb[1], ub[INPUTS + 1];",
        "    ob[3 * event] = R(bar);",
        "    ob[3 * event + 1] = R(bar * turn);",
        "    times_reverse(w, 0, NULL, NULL, NULL, ob, xb, kb, tb, ub);",
        "}",
        "",
        "static void timing_forward(Work *w, double *out) { times_forward(w, 0, NULL, NULL, NULL, out); }",
        "",
    ]
    table = f"static const int TIMING_HAS[][3] = {{{has or '{0}'}}}; /* first time, interval, last time */"
    return [table, *_both("times", _equations(model, outputs, place, "the times of an event")), *back]
