"""The delays of a model in the kernel: what is delayed and the history as C, forward and in reverse."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from gbspec.backends.native.flat import Leaf, NotCoveredError, flatten
from gbspec.backends.native.sections import Equations, Site
from gbspec.ir import Explicit, Method, Model

_GIVEN = "const real *restrict x, const real *restrict time, const real *restrict inputs"
_BACK = "const real *restrict ob, real *restrict xb, double *restrict kb, real *restrict tb, real *restrict ub"
_UNUSED = "    (void)w; (void)block; (void)x; (void)time; (void)inputs;"
_UNUSED_BACK = "    (void)ob; (void)xb; (void)kb; (void)tb; (void)ub;"

Place = Callable[[Leaf], str]


def check(model: Model, method: Method) -> None:
    """Raises NotCoveredError for what the kernel does not offer together with delays."""
    if not model.delays:
        return
    if not isinstance(method, Explicit):
        raise NotCoveredError("it has delays, for which steps are explicit")
    if model.events:
        raise NotCoveredError("it has both delays and events")


class Late:
    """The delayed quantities of a model, those with the same time together: `sites`, their network calls, and `lines`,
    the functions that `delays.c` calls."""

    def __init__(self, model: Model, method: Method, first_site: int, place: Place) -> None:
        lags = list(dict.fromkeys(delay.lag for delay in model.delays))
        groups = [[i for i, delay in enumerate(model.delays) if delay.lag == lag] for lag in lags]
        self.sizes = {"DELAYS": len(model.delays), "LAGS": len(lags)}
        self.sites: list[Site] = []
        self.lines: list[str] = []
        if not groups:
            return
        own = replace(model, delays=())  # what is delayed holds no delays itself
        first, parts = [first_site], []
        for group in groups:
            flat = flatten(own, [model.delays[i].value for i in group])
            equations = Equations(own, flat, first[-1], place, "late", timed=True)
            self.sites += equations.sites
            first.append(first_site + len(self.sites))
            parts.append(equations)
        wide = max(map(len, groups))
        filled = [group + [0] * (wide - len(group)) for group in groups]
        self.lines = [
            f"static const double TABLEAU_NODES[] = {_braces(map(float, method.nodes))};",
            f"static const int LATE_COUNT[] = {_braces([len(group) for group in groups])}; /* delays by a time */",
            f"static const int LATE_OF[][{wide}] = {{{', '.join(map(_braces, filled))}}};",
            f"static const int LATE_SITES[] = {_braces(first)}; /* first calls of their quantities */",
            "",
            *(line for i, equations in enumerate(parts) for line in _both(f"late{i}", equations)),
            *_chosen(len(parts)),
            *_both("history", _history(own, place)),
        ]


def _braces(values: Iterable[float]) -> str:
    return f"{{{', '.join(map(str, values))}}}"


def _history(model: Model, place: Place) -> Equations:
    """The states before the start, from those at the start."""
    flat = flatten(model, [s.symbol if s.history is None else s.history for s in model.states])
    if flat.calls:
        raise NotCoveredError("an unknown function stands in the history of a state")
    return Equations(model, flat, 0, place, "history", timed=True)


def _both(name: str, equations: Equations) -> list[str]:
    return [
        f"static void {name}_forward(Work *w, size_t block, {_GIVEN}, real *restrict out) {{",
        _UNUSED,
        *equations.forward(),
        "}",
        "",
        f"static void {name}_reverse(Work *w, size_t block, {_GIVEN}, {_BACK}) {{",
        _UNUSED,
        _UNUSED_BACK,
        *equations.reverse(),
        "}",
        "",
    ]


def _chosen(count: int) -> list[str]:
    """The functions that choose by the time of a delay."""
    lines = []
    for way, given, names in (("forward", "real *restrict out", "out"), ("reverse", _BACK, "ob, xb, kb, tb, ub")):
        lines += [
            f"static void late_{way}(Work *w, int lag, size_t block, {_GIVEN}, {given}) {{",
            "    switch (lag) {",
            *(f"    case {i}: late{i}_{way}(w, block, x, time, inputs, {names}); break;" for i in range(count)),
            "    }",
            "}",
            "",
        ]
    return lines
