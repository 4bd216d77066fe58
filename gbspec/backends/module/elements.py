"""Names of the elements of arrays in the generated text: one expression for each array."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

from gbspec.ir import Model, StateArray


class Code(str):
    """Python code that is written verbatim among the entries of a literal."""


def runs_of(model: Model, names: Sequence[str]) -> Iterator[StateArray | str]:
    """The names in order, with an array in place of its elements if these are consecutive."""
    begins = {array.names[0]: array for array in model.arrays if _regular(array)}
    place = 0
    while place < len(names):
        array = begins.get(names[place])
        if array is not None and tuple(names[place : place + array.count]) == array.names:
            yield array
            place += array.count
        else:
            yield names[place]
            place += 1


def names_of(model: Model, names: Sequence[str]) -> tuple[str, ...]:
    """Entries of a tuple of names."""
    return tuple(run if isinstance(run, str) else Code(f"*({_each(run)})") for run in runs_of(model, names))


def table_of(model: Model, table: Mapping[str, object]) -> dict[str, object]:
    """Entries of a dictionary; elements of an array must all have the same value, or are listed one by one."""
    found: dict[str, object] = {}
    for run in runs_of(model, tuple(table)):
        if isinstance(run, str):
            found[run] = table[run]
        elif len({table[name] for name in run.names}) == 1:
            found[Code(f"**dict.fromkeys(({_each(run)}), ")] = table[run.names[0]]
        else:
            found |= {name: table[name] for name in run.names}
    return found


def places_of(model: Model, places: Sequence[int | None]) -> tuple[object, ...]:
    """Entries of a tuple of indices; those of whole arrays as ranges."""
    names = [None if place is None else model.states[place].name for place in places]
    found: list[object] = []
    for run in runs_of(model, [name or "" for name in names]):
        if isinstance(run, str):
            found.append(model.state_index[run] if run else None)
        else:
            found.append(Code(f"*range({run.position}, {run.position + run.count})"))
    return tuple(found)


def _regular(array: StateArray) -> bool:
    return array.count > 2 and all(name == f"{array.name}_{array.first + k}" for k, name in enumerate(array.names))


def _each(array: StateArray) -> str:
    """`f"c_{i}" for i in range(1, 513)`."""
    name = json.dumps(array.name, ensure_ascii=False)[:-1]
    return f'f{name}_{{i}}" for i in range({array.first}, {array.last + 1})'
