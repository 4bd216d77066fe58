"""The interface of the kernel: its structs and functions. The C declarations and the Python side (`library`) are both
made from these lists."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

Element = Literal["double", "int64_t", "int32_t"]


@dataclass(frozen=True)
class Field:
    """An integer (`shape` None), or a pointer to an array of `shape`: lengths separated by commas, each the name of a
    field, of a size of the source (`STATES`) or of a length that the struct's arrays share, or one of these plus 1.

    `written`: the C code writes into it; `optional`: it may be NULL.
    """

    name: str
    about: str = ""
    element: Element = "int64_t"
    shape: str | None = None
    written: bool = False
    optional: bool = False

    @cached_property
    def lengths(self) -> tuple[tuple[str, int], ...]:
        """The lengths of an array's axes: for each a name and the number added to it."""
        parts = [part.strip().partition(" + ") for part in self.shape.split(",")] if self.shape else []
        return tuple((name, int(more or 0)) for name, _, more in parts)

    @property
    def declaration(self) -> str:
        """The line of the C struct."""
        if self.shape is None:
            return f"    int64_t {self.name};" + (f" /* {self.about} */" if self.about else "")
        constant = "" if self.written else "const "
        about = "".join(f"[{length.strip()}]" for length in self.shape.split(",")) + (
            f": {self.about}" if self.about else ""
        )
        return f"    {constant}{self.element} *{self.name}; /* {about}{'; or NULL' if self.optional else ''} */"


def _reals(name: str, shape: str, about: str = "", optional: bool = False) -> Field:
    return Field(name, about, "double", shape, optional=optional)


def _wholes(name: str, shape: str, about: str = "") -> Field:
    return Field(name, about, "int64_t", shape)


def _places(name: str, shape: str, about: str = "", optional: bool = False) -> Field:
    return Field(name, about, "int32_t", shape, optional=optional)


def _found(name: str, shape: str, about: str = "", optional: bool = False) -> Field:
    return Field(name, about, "double", shape, written=True, optional=optional)


STRUCTS: Mapping[str, tuple[Field, ...]] = {
    # Data that do not depend on the parameter vector (except for the times at which sub-steps are cut).
    "Data": (
        Field("depth", "most sub-steps of a trajectory"),
        Field("trajectories"),
        Field("forced", "whether measurements reset any state"),
        _reals("t", "trajectories, depth", "starts of sub-steps"),
        _reals("h", "trajectories, depth", "their lengths"),
        _reals("inputs", "trajectories, depth, NODES, INPUTS"),
        _reals("condition", "trajectories, CONDITIONS"),
        _wholes("steps", "trajectories", "numbers of sub-steps"),
        _places("row_at", "trajectories, depth + 1", "key row on arrival, -1 for none"),
        _reals("row_time", "rows"),
        _reals("row_inputs", "rows, INPUTS"),
        _reals("measured", "rows, CHANNELS"),
        _reals("factor", "rows, CHANNELS", "of residuals; 0: not measured"),
        _reals("value", "rows, STATES", "to which states are reset, in part or wholly"),
        _reals("weight", "rows, STATES", "of `value` in a reset; 1: full reset"),
        _places("arrival_at", "trajectories, depth", "first arrival at a sub-step's start, -1 for none", optional=True),
        _places("arrival_next", "arrivals", "next arrival at the same place, -1 for none", optional=True),
        _places("arrival_state", "arrivals", "index of the state it is added to", optional=True),
        _places("arrival_cuts", "arrivals", "whether it moves the start of its sub-step", optional=True),
        _reals("slope", "trajectories, depth, INPUTS", "of inputs in time, if sub-steps are cut", optional=True),
        _reals("band", "one", "near the end of a sub-step, in which events wait for the next one", optional=True),
        _reals("begin", "trajectories", "their starts, for delays", optional=True),
        _reals("before", "trajectories, INPUTS", "inputs before these", optional=True),
        _places("logarithmic", "CHANNELS"),
        _reals("sizes", "CHANNELS", "of counts with residuals on the scale of their noise, 0: none", optional=True),
        _places("side", "rows, CHANNELS", "of a limit that values lie on: -1, 1; 0: no limit", optional=True),
        _reals("level", "CHANNELS", "standard deviation of noise in units of residuals, 0: not known", optional=True),
        _reals(
            "lu",
            "trajectories, depth, MATRIX, MATRIX",
            "factored matrices, for methods with any; Jacobians with events",
            optional=True,
        ),
        _places("pivots", "trajectories, depth, MATRIX", "the exchanges of rows of factors, from 1", optional=True),
    ),
    # Data that depend on the parameter vector.
    "Inputs": (
        _reals("weights", "WEIGHTS", "layer by layer ([out][in], then the bias), network by network"),
        _reals("numbers", "NUMBERS", "scales that the forms of contracts use"),
        _reals("constants", "trajectories, CONSTANTS"),
        _reals("initial", "trajectories, STATES"),
        _reals("amounts", "arrivals", "added to the state"),
        _reals("lags", "trajectories, LAGS", "the times of delays, each once"),
    ),
    # The share of a call of `run`: every `stride`-th tile of `order`, beginning with `first`.
    "Share": (
        Field("count"),
        Field("first"),
        Field("stride"),
        Field("gradient", "whether the reverse pass is run"),
        _wholes("order", "count", "trajectories"),
        _reals("cotangent", "rows, CHANNELS", "of the predictions; NULL: the residuals themselves", optional=True),
        _found("d_weights", "WEIGHTS", "sum over the share"),
    ),
    # Results of `run` for the trajectories of its share: derivatives are products of the cotangent with the Jacobian of
    # the residuals.
    "Outputs": (
        _found("residuals", "rows, CHANNELS"),
        _found("states", "rows, STATES", "on arrival, before resets"),
        _found("d_constants", "trajectories, LEARNABLES"),
        _found("d_initial", "trajectories, STATES"),
        _found("d_amounts", "arrivals"),
        _found("d_times", "arrivals", "added to, if TIMED: for arrivals that cut sub-steps"),
        _found("d_lags", "trajectories, LAGS"),
        _found("late", "rows, DELAYS", "delayed values"),
        Field("happened", "how often each event happens", "int32_t", "trajectories, EVENTS", written=True),
        Field("endless", "whether events have no end", "int32_t", "trajectories", written=True),
        Field("uncut", "sub-steps across switches of right-hand sides", "int32_t", "trajectories", written=True),
    ),
    # Intervals between consecutive key rows, ordered by their numbers of sub-steps.
    "Intervals": (
        Field("count"),
        Field("depth", "most sub-steps of an interval"),
        Field("columns", "of `d_weights`, the first WEIGHTS of which are written"),
        Field("arrivals"),
        _wholes("owner", "count", "trajectory"),
        _wholes("first", "count", "first sub-step"),
        _wholes("steps", "count", "number of sub-steps"),
        _reals("start", "count, STATES"),
        _reals("factor", "WEIGHTS", "see `write_lane`"),
        _reals("shift", "WEIGHTS"),
        _found("d_start", "count, STATES, STATES", "of each final state with respect to the first"),
        _found("d_weights", "count, STATES, columns", "added to", optional=True),
        _found("d_constants", "count, STATES, LEARNABLES", "added to"),
        _found("d_amounts", "STATES, arrivals"),
        _found("d_times", "STATES, arrivals", "added to"),
    ),
    # Derivatives of the measured values of whole trajectories, in models with delays. Columns: learnable constants in
    # natural units, initial states, and the weights, if there are so many columns.
    "Sensitivities": (
        Field("count"),
        Field("columns"),
        Field("window", "sub-steps that the longest delay looks back, and a few more"),
        _wholes("order", "count", "trajectories"),
        _reals("factor", "WEIGHTS", "see `write_lane`"),
        _reals("shift", "WEIGHTS"),
        _reals("of_amounts", "arrivals, LEARNABLES", "derivatives of what arrives"),
        _reals("of_times", "arrivals, LEARNABLES", "and of its time"),
        _reals("of_lags", "trajectories, LAGS, LEARNABLES"),
        _places("place", "rows, CHANNELS", "row of the Jacobian, -1: none"),
        _reals("scale", "rows, CHANNELS", "factor of this row"),
        _found("out", "residuals, columns"),
    ),
    # Derivatives of intervals and of the residuals at their ends.
    "Links": (
        Field("rows"),
        Field("columns"),
        _wholes("owner", "rows", "the sum that a row adds to; an owner's rows follow each other in time"),
        _reals("d_start", "rows, STATES, STATES"),
        _reals("own", "rows, STATES, columns", "added by the interval itself"),
        _reals("release", "rows, STATES", "factor that resets leave"),
        _wholes("begin", "rows", "first residual"),
        _wholes("end", "rows", "one past the last"),
        _reals("d_state", "residuals, STATES"),
        _found("sum", "owners, STATES, columns", "derivatives of the owners' states"),
        _found("out", "residuals, columns", "rows of the Jacobian"),
    ),
    # The accepted steps of a tile of trajectories, each on its own solution.
    "Walk": (
        Field("count", "trajectories, at most TILE"),
        Field("room", "most steps of a trajectory"),
        Field("most", "attempts between two full resets"),
        _wholes("who", "TILE"),
        _reals("rtol", "one", "tolerance of the error estimate; negative: each sub-step is one step"),
        _reals("floor", "STATES", "added to the sizes of the states"),
        Field("taken", "number of steps", "int64_t", "TILE", written=True),
        Field("cell", "sub-step that a step is part of", "int32_t", "TILE, room", written=True),
        _found("begin", "TILE, room", "after its start"),
        _found("length", "TILE, room", "NaN: there is no solution"),
        _found("factors", "TILE, room, STATES, STATES", "of its matrix; Jacobians with events", optional=True),
        Field("exchanges", "of rows", "int32_t", "TILE, room, STATES", written=True, optional=True),
    ),
}
"""The structs, by name."""

SPACE = "char *space"
"""Work space; the function of the same name gives its size in bytes."""

FUNCTIONS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "work_bytes": ("int64_t", ("int64_t depth",)),
    "run": ("void", ("Data", "Inputs", "Share", "Outputs", SPACE)),
    "interval_bytes": ("int64_t", ("int64_t depth",)),
    "intervals": ("void", ("Data", "Inputs", "Intervals", SPACE)),
    "chain": ("void", ("Links",)),
    "sensitivity_bytes": ("int64_t", ("int64_t depth", "int64_t columns", "int64_t window")),
    "sensitivities": ("void", ("Data", "Inputs", "Sensitivities", SPACE)),
    "control": ("int64_t", ("Data", "Inputs", "Walk", SPACE)),
}
"""The exported functions: the type of the result and the parameters, structs by their names."""


def declarations() -> Iterator[str]:
    """The C declarations of all structs and the prototypes of all functions."""
    for name, fields in STRUCTS.items():
        yield "typedef struct {"
        yield from (field.declaration for field in fields)
        yield f"}} {name};"
        yield ""
    for name, (result, parameters) in FUNCTIONS.items():
        given = (f"const {p} *{p.lower()}" if p in STRUCTS else p for p in parameters)
        yield f"{result} {name}({', '.join(given)});"
