"""The C source of a model's kernel: its sizes and equations, and the files that do not depend on the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from importlib import resources
from itertools import pairwise
from typing import Literal, assert_never

from gbspec.backends.native import delays, events, row_groups
from gbspec.backends.native.flat import Leaf, NotCoveredError, flatten, numbers_of
from gbspec.backends.native.lookups import table_functions
from gbspec.backends.native.sections import Equations, Site
from gbspec.backends.native.structs import declarations
from gbspec.ir import COUNT_SHIFT, LEAST_SIZE, LOG_FLOOR, RK4, Explicit, Method, Model, Network, RosenbrockW, scheduled

Precision = Literal["float64", "float32"]

TILE = 4
"""Trajectories of a tile, which are computed together."""

KEPT_BYTES = 4 * 2**20
"""Most activations stored at a time, per thread."""

GROUP_BYTES = 32 * 2**10
"""Activations of a layer over which a block of the weights' gradient is summed at a time (they fit in the cache)."""

MOST_LAYERS = 15
MOST_ARGUMENTS = 32

RHS_PLACES = {
    "state": "x[{}*TILE + t]",
    "condition": "w->condition[{}*TILE + t]",
    "input": "inputs[{}*TILE + t]",
    "delay": "inputs[(INPUTS + {})*TILE + t]",
    "constant": "w->constants[{}*TILE + t]",
    "time": "time[t]",
    "number": "w->numbers[{}]",
    "side": "w->side[{}]",
}
OBSERVE_PLACES = RHS_PLACES | {
    "input": "R(w->data->row_inputs[(size_t)w->rows[t]*INPUTS + {}])",
    "delay": "w->seen[{}*TILE + t]",
    "time": "R(w->data->row_time[w->rows[t]])",
}


@dataclass(frozen=True)
class Source:
    """C source of the unroll of a model; `sizes` maps names to lengths (`STATES`, ...)."""

    text: str
    sizes: dict[str, int]


def source(model: Model, precision: Precision = "float64", method: Method = RK4, blocks: int = 1) -> Source:
    """C of a model's unroll by a method; its states are in `blocks`, each of which is divided by a step's matrix.

    Raises NotCoveredError, with the reason, for a model that torch must run.
    """
    _check(model)
    events.check(model, precision)
    delays.check(model, method)
    balances = flatten(model, model.balances)
    # Steps that events cut are taken again one by one in the reverse pass; those with delays form their own products.
    once = not model.events and not model.delays
    rhs = Equations(model, balances, 0, _places(RHS_PLACES), "rhs", once=once, timed=_timed(model))
    late = delays.Late(model, method, len(rhs.sites), _places(RHS_PLACES))
    observe = Equations(
        model,
        flatten(model, [channel.value for channel in model.channels]),
        len(rhs.sites) + len(late.sites),
        _places(OBSERVE_PLACES),
        "observe",
        skip="w->rows[t] < 0",
        late_bar="w->seen_bar[{}*TILE + t]",
    )
    numbers = _numbers(model, precision, method, late, [*rhs.sites, *late.sites], observe.sites)
    numbers["MATRIX"] = len(model.states) // blocks
    controlled = blocks == 1 and _plans(model, precision, method)
    head = [
        *(f"#include <{name}.h>" for name in ("math", "stddef", "stdint", "string")),
        "",
        *(f"#define {name} {value}" for name, value in numbers.items()),
        *_tableau(method),
        *_sites([*rhs.sites, *late.sites, *observe.sites]),
        *(row_groups.declared(balances) if controlled and isinstance(method, RosenbrockW) else []),
        "",
        *declarations(),
        "",
    ]
    before, after = ["runtime", "networks", "work"], ["steps", "rows", "driver"]
    if model.events:
        before.insert(2, "crossing")
        after[1:1] = ["events", "switches", "events_cut", "events_reverse"]
    if model.delays:
        after[1:1] = ["delays", "delays_reverse"]
    # Only least-squares fits need the Jacobian, and they run in double precision.
    jacobian = "sensitivities" if model.delays else "jacobian"
    after += ["trained", jacobian] if precision == "float64" else []
    if controlled:
        after += ["control", "interrupted" if model.events else "side_by_side"]
    own = [*_equations(model, rhs, observe), *late.lines, *events.functions(model, _places(RHS_PLACES))]
    parts = [*map(_text, before), *table_functions(model.tables), *own, *map(_text, after)]
    return Source(
        "\n".join([*head, *parts]), {name: value for name, value in numbers.items() if isinstance(value, int)}
    )


@cache
def _text(name: str) -> str:
    return resources.files("gbspec.backends.native").joinpath(f"{name}.c").read_text(encoding="utf-8")


def _check(model: Model) -> None:
    for network in model.networks:
        if len(network.sizes) > MOST_LAYERS or network.sizes[0] > MOST_ARGUMENTS:
            raise NotCoveredError(f"the network `{network.name}` has too many layers or arguments")
    if not model.states:
        raise NotCoveredError("it has no states")
    if model.algebraics:
        raise NotCoveredError("it has algebraic variables, which a search finds in every step")


def _plans(model: Model, precision: Precision, method: Method) -> bool:
    """Whether the kernel can choose adaptive steps."""
    return precision == "float64" and method.b_error is not None and not model.delays


def _timed(model: Model) -> bool:
    """Whether learned quantities, the lags of doses or the times of events, move the starts of sub-steps."""
    if model.events or model.delays:
        return True
    learned = {learnable.symbol for learnable in model.learnables}
    return any(dose.lag.free_symbols & learned for dose in model.doses)


def _places(table: Mapping[str, str]) -> Callable[[Leaf], str]:
    """A function from a leaf to its C text."""
    return lambda leaf: table[leaf.kind].format(leaf.index)


def _numbers(
    model: Model, precision: Precision, method: Method, late: delays.Late, kept: Sequence[Site], others: Sequence[Site]
) -> dict[str, int | float]:
    size = 8 if precision == "float64" else 4
    # Events cut each trajectory at times of its own, and scalar equations gain nothing where delays differ by lane.
    tile = 1 if model.events or (model.delays and not model.networks) else TILE
    per_step = 4 * tile * max([n for network in model.networks for n in network.hidden] or [1]) * size
    return {
        "REAL_IS_FLOAT": int(precision == "float32"),
        "TILE": tile,
        "STATES": len(model.states),
        "CONDITIONS": len(model.conditions),
        "INPUTS": len(model.inputs),
        "CONSTANTS": len(model.constant_names),
        "LEARNABLES": len(model.learnables),
        "CHANNELS": len(model.channels),
        "NETWORKS": len(model.networks),
        "WEIGHTS": sum((a + 1) * b for network in model.networks for a, b in pairwise(network.sizes)),
        "NUMBERS": len(numbers_of(model)),
        "RHS_SITES": len(kept),
        "SITES": len(kept) + len(others),
        "TIMED": int(_timed(model)),
        "SCHEDULED": int(bool(scheduled(model))),
        "STAGES": method.advancing,
        "EVALUATIONS": method.advancing + bool(model.delays),
        "NODES": len(method.nodes),
        "KEPT_BYTES": KEPT_BYTES,
        **events.sizes(model),
        **late.sizes,
        "GIVEN": len(model.inputs) + len(model.delays),
        "WEIGHT_STEPS": max(1, GROUP_BYTES // per_step),
        "LOG_FLOOR": LOG_FLOOR,
        "COUNT_SHIFT": COUNT_SHIFT,
        "LEAST_SIZE": LEAST_SIZE,
    }


def _tableau(method: Method) -> list[str]:
    """The coefficients; with an error estimate all Runge-Kutta stages, else those that a step needs."""
    n = len(method.b) if method.b_error else method.advancing
    places = [method.nodes.index(c) for c in method.c[: method.advancing]]
    lines = [
        _table("A", method.a, n),
        f"static const double TABLEAU_B[{n}] = {_braces(map(float, method.b[:n]))};",
        f"static const double TABLEAU_C[{n}] = {_braces(map(float, method.c[:n]))};",
        f"static const int TABLEAU_NODE[{n}] = {_braces(places)};",
    ]
    if method.b_error and method.embedded_order is not None:
        lines += [
            f"#define TRIED {n} /* Runge-Kutta stages with those of the error estimate */",
            f"#define ORDER {method.embedded_order + 1}",
            f"static const double TABLEAU_E[{n}] = {_braces(map(float, method.b_error))};",
        ]
    match method:
        case Explicit():
            return [*lines, "#define MATRICES 0"]
        case RosenbrockW():
            return [
                *lines,
                "#define MATRICES 1",
                f"#define GAMMA {float(method.gamma)!r}",
                _table("V", method.coupling, n),
            ]
        case _:
            assert_never(method)


def _table(name: str, rows: Sequence[Sequence[Fraction]], n: int) -> str:
    """A lower triangular table."""
    filled = [[*map(float, row), *[0.0] * (n - len(row))] for row in rows[:n]]
    return f"static const double TABLEAU_{name}[{n}][{n}] = {{{', '.join(map(_braces, filled))}}};"


def _braces(values: Iterable[object]) -> str:
    """`{1.0, 2.0}`."""
    return f"{{{', '.join(map(repr, values))}}}"


def _sites(sites: Sequence[Site]) -> list[str]:
    networks = [site.call.network for site in sites] or [0]
    invariant = [int(site.invariant) for site in sites] or [0]
    return [
        f"static const int SITE_NETWORK[] = {_braces(networks)};",
        f"static const int SITE_INVARIANT[] = {_braces(invariant)}; /* whether a call is made once for a tile */",
    ]


def _equations(model: Model, rhs: Equations, observe: Equations) -> list[str]:
    lines = [
        *_set_networks(model.networks),
        "",
        "static void invariant_forward(Work *w) {",
        "    (void)w;",
        *rhs.invariant_forward(),
        "}",
        "",
    ]
    places = "const real *restrict x, const real *restrict time, const real *restrict inputs"
    for equations, name, given in ((rhs, "rhs", places), (observe, "observe", "const real *restrict x")):
        forward = f"static void {name}_forward(Work *w, size_t block, {given}, real *restrict out) {{"
        moved = ", real *restrict tb, real *restrict ub" if name == "rhs" else ""
        reverse = (
            f"static void {name}_reverse(Work *w, size_t block, {given}, const real *restrict ob, "
            f"real *restrict xb, double *restrict kb{moved}) {{"
        )
        unused = ["    (void)w; (void)block; (void)x;"] + (["    (void)time; (void)inputs;"] if name == "rhs" else [])
        lines += [forward, *unused, *equations.forward(), "}", ""]
        unused += ["    (void)ob; (void)xb; (void)kb;"] + (["    (void)tb; (void)ub;"] if name == "rhs" else [])
        lines += [reverse, *unused, *equations.reverse(), "}", ""]
    return lines


def _set_networks(networks: Sequence[Network]) -> list[str]:
    lines = ["static void set_networks(Work *w) {"]
    for i, network in enumerate(networks):
        lines.append(f"    Net *net{i} = &w->nets[{i}]; /* {_ascii(network.name)} */")
        lines.append(f"    net{i}->layers = {len(network.sizes) - 1};")
        lines += [f"    net{i}->size[{j}] = {size};" for j, size in enumerate(network.sizes)]
        for layer in range(len(network.hidden)):
            parts = activation_parts(network, layer)
            lines.append(f"    net{i}->kinds[{layer + 1}] = {len(parts)};")
            for j, (kind, count) in enumerate(parts):
                width = network.hidden[layer]
                filling = f" + PAD({width}) - {width}" if j == len(parts) - 1 else ""
                lines.append(f"    net{i}->kind[{layer + 1}][{j}] = {kind.upper()};")
                lines.append(f"    net{i}->count[{layer + 1}][{j}] = {count}{filling};")
    return [*lines, "    (void)w;", "}"]


def activation_parts(network: Network, layer: int) -> list[tuple[str, int]]:
    """Activations of a hidden layer, each with its number of units."""
    if network.layout is None:
        return [(network.activation, network.hidden[layer])]
    count = {"free": 0, "convex": 0, "concave": 0, "saturating": 0}
    for block in network.layout.hidden[layer]:
        count[block.shape] += block.count
    parts = [
        (network.activation, count["free"]),
        ("softplus", count["convex"] + count["concave"]),
        ("tanh", count["saturating"]),
    ]
    return [(kind, n) for kind, n in parts if n]


def _ascii(text: str) -> str:
    """A name in ASCII, for a comment."""
    return text.encode("ascii", "replace").decode().replace("*/", "* /")
