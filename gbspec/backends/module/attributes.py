"""The class attributes of a generated module: names, defaults, ranges, units, descriptions, networks."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable

from gbspec.backends.module.elements import Code, names_of, places_of, table_of
from gbspec.ir import Condition, Declared, Input, Learnable, Method, Model, Network, Range, State

WIDTH = 120
"""Line length of the generated text."""

NAMES = "tuple[str, ...]"
TYPES = {
    **dict.fromkeys(("title", "solver", "time"), "str"),
    "categories": "dict[str, tuple[str, ...]]",
    **dict.fromkeys(("states", "conditions", "inputs", "channels", "unknowns", "constants", "learnables"), NAMES),
    **dict.fromkeys(("per_trajectory", "doses", "interpolation"), NAMES),
    "channel_states": "tuple[int | None, ...]",
    "defaults": "dict[str, tuple[float | None, ...]]",
    "ranges": "dict[str, tuple[float, float]]",
    "units": "dict[str, str]",
    "descriptions": "dict[str, str]",
    "networks": "tuple[dict[str, Any], ...]",
}
"""The types of the attributes, for type checkers; those of the protocol."""


def sizes(network: Network) -> tuple[int, ...]:
    """Numbers of arguments, of hidden units in each layer, and of outputs."""
    return network.sizes


def attributes(model: Model, method: Method) -> str:
    """Assignments in the body of the generated class."""
    constants = (*(c.value for c in model.constants), *(k.start for k in model.learnables))
    ranged: tuple[State | Condition | Input | Learnable, ...] = (
        *model.states,
        *model.conditions,
        *model.inputs,
        *model.learnables,
    )
    named: tuple[Declared, ...] = (
        model.time,
        *model.states,
        *model.conditions,
        *model.inputs,
        *model.constants,
        *model.learnables,
        *model.unknowns,
        *model.channels,
    )
    values: dict[str, object] = {
        "title": model.title,
        "solver": method.name,
        "time": model.time.name,
        "states": names_of(model, [state.name for state in model.states]),
        "conditions": tuple(condition.name for condition in model.conditions),
        "inputs": tuple(item.name for item in model.inputs),
        "channels": names_of(model, [channel.name for channel in model.channels]),
        "unknowns": tuple(unknown.name for unknown in model.unknowns),
        "constants": model.constant_names,
        "learnables": tuple(learnable.name for learnable in model.learnables),
        "per_trajectory": tuple(learnable.name for learnable in model.learnables if learnable.per_trajectory),
        "doses": tuple(dose.state for dose in model.doses),
        "interpolation": tuple(item.interpolation for item in model.inputs),
        "channel_states": places_of(model, [channel.state for channel in model.channels]),
        "defaults": {
            "constants": constants,
            # Labels tell trajectories apart in the training: no equation has them.
            "conditions": tuple(0.0 if c.labels and c.default is None else c.default for c in model.conditions),
            "inputs": tuple(item.default for item in model.inputs),
        },
        "ranges": table_of(model, {item.name: _ends(item.range) for item in ranged if item.range is not None}),
        "units": table_of(model, _first((item.name, item.unit) for item in named)),
        "descriptions": table_of(model, _first((item.name, item.description) for item in named)),
        "networks": tuple(_network(model, network) for network in model.networks),
    }
    categories = {condition.name: condition.categories for condition in model.conditions if condition.categories}
    if categories:
        values["categories"] = categories
    comments = {
        "categories": "the names of the numbers 0, 1, and so on of a condition",
        "solver": "the method that takes the steps",
        "constants": "known constants first, then the learnable ones",
        "interpolation": "of the inputs between their values",
        "channel_states": "the state that a channel is, None where it is an expression",
    }
    return "\n".join(
        _attribute(f"{name}: ClassVar[{TYPES[name]}]", v, comments.get(name)) for name, v in values.items()
    )


def tables(model: Model) -> str:
    """The assignment of the pieces of tables, in the module; empty without tables."""
    if not model.tables:
        return ""
    lines = ["TABLES: dict[str, Any] = {"]
    for table in model.tables:
        curve = table.curve
        coefficients = curve.coefficients
        lines += [f"    {_text(table.name)}: {{", '        "knots": (']
        lines += [f"            ({_filled(places, 16)})," for places in curve.knots]
        lines += ["        ),", f'        "powers": {coefficients.shape[-1]},']
        lines += [f'        "coefficients": ({_filled(coefficients.ravel().tolist(), 12)}),']
        lines += [f'        "strict": {curve.outside == "error"},', "    },"]
    return "\n".join(["", "", "# The tables: places of each argument, and the polynomials between them.", *lines, "}"])


def _filled(values: Iterable[float], indent: int) -> str:
    """The entries of a tuple, over several lines if they are many."""
    texts = [repr(float(value)) for value in values]
    line = ", ".join(texts)
    if len(line) <= 60:
        return f"{line}," if len(texts) == 1 else line
    lines = textwrap.wrap(f"{line},", WIDTH - indent - 4, break_long_words=False, break_on_hyphens=False)
    margin = " " * indent
    return f"\n{margin}" + f"\n{margin}".join(lines) + f"\n{margin[:-4]}"


def _network(model: Model, network: Network) -> dict[str, object]:
    neutral = {unknown.name: unknown.neutral for unknown in model.unknowns}
    gates = 0 if network.layout is None else network.layout.gates
    return {
        "name": network.name,
        "outputs": network.outputs,
        "arguments": tuple(argument.name for argument in network.arguments),
        "sizes": sizes(network),
        "activation": network.activation,
        "ranges": tuple(None if argument.range is None else _ends(argument.range) for argument in network.arguments),
        "neutral": (*(neutral[output] for output in network.outputs), *(0.0,) * gates),
        "raw": any(unknown.form is not None for unknown in model.unknowns if unknown.name in network.outputs),
        "layout": None if network.layout is None else network.layout.plain(),
    }


def _first(pairs: Iterable[tuple[str, str | None]]) -> dict[str, str]:
    """The description of each name; a channel that is a state has the state's."""
    table: dict[str, str] = {}
    for name, text in pairs:
        if text:
            table.setdefault(name, text)
    return table


def _ends(span: Range) -> tuple[float, float]:
    return float(span.low), float(span.high)


def _attribute(name: str, value: object, comment: str | None) -> str:
    """`name = value  # comment`."""
    head, *rest = _lines(f"{name} = ", value, "", WIDTH - 4)
    remark = f"  # {comment}" if comment else ""
    return "\n".join([head + (remark if len(head) + len(remark) <= WIDTH - 4 else ""), *rest])


def _lines(head: str, value: object, tail: str, width: int) -> list[str]:
    """A literal on one line if it fits, else one line per entry."""
    line = f"{head}{_text(value)}{tail}"
    if len(line) <= width or not isinstance(value, dict | tuple):
        return [line]
    opening, closing = "{}" if isinstance(value, dict) else "()"
    entries = [_entry(k, v) for k, v in value.items()] if isinstance(value, dict) else [("", v, "") for v in value]
    inside = [f"    {part}" for key, entry, end in entries for part in _lines(key, entry, f"{end},", width - 4)]
    return [head + opening, *inside, closing + tail]


def _entry(key: str, value: object) -> tuple[str, object, str]:
    """The text before an entry's value, the value, and the text after it."""
    return (str(key), value, ")") if isinstance(key, Code) else (f"{_text(key)}: ", value, "")


def _text(value: object) -> str:
    """A literal that Python reads back as the same value; strings in double quotes, as in JSON."""
    match value:
        case Code():
            return str(value)
        case str():
            return json.dumps(value, ensure_ascii=False)
        case float() if not math.isfinite(value):
            return "np.nan" if math.isnan(value) else "np.inf" if value > 0 else "-np.inf"
        case tuple():
            inside = ", ".join(map(_text, value))
            return f"({inside},)" if len(value) == 1 else f"({inside})"
        case dict():
            entries = (_entry(key, part) for key, part in value.items())
            return "{" + ", ".join(f"{before}{_text(part)}{end}" for before, part, end in entries) + "}"
    return repr(value)
