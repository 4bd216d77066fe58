"""Groups of states whose balances share no state: one reverse pass gives the rows of the Jacobian of a whole group.

This is the grouping of Curtis, Powell and Reid (1974) with rows in place of columns: on a grid, where each state sees
its neighbours only, three groups are enough for any number of states.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy

from gbspec.backends.native.flat import Flat, Operation


def seen_states(flat: Flat) -> list[frozenset[int]]:
    """The states that each output depends on."""
    seen = {s: frozenset([leaf.index]) if leaf.kind == "state" else frozenset() for s, leaf in flat.leaves.items()}

    def union(values: Sequence[sympy.Basic]) -> frozenset[int]:
        return frozenset[int]().union(*(seen[s] for value in values for s in value.free_symbols))

    for step in flat.steps:
        if isinstance(step, Operation):
            seen[step.symbol] = union([step.value])
        else:
            seen |= dict.fromkeys(step.results, union(step.arguments))
    return [union([output]) for output in flat.outputs]


def groups_of(seen: Sequence[frozenset[int]]) -> list[int]:
    """The group of each row: the first one of whose rows none has an entry in the same columns."""
    taken: list[set[int]] = []
    out = []
    for columns in seen:
        place = next((g for g, others in enumerate(taken) if others.isdisjoint(columns)), len(taken))
        if place == len(taken):
            taken.append(set())
        taken[place] |= columns
        out.append(place)
    return out


def declared(flat: Flat) -> list[str]:
    """C of the groups: their number, the group of each row, and which entries of the Jacobian are not always zero."""
    seen = seen_states(flat)
    group, size = groups_of(seen), len(seen)
    rows = ("{" + ", ".join("1" if j in columns else "0" for j in range(size)) + "}" for columns in seen)
    return [
        f"#define GROUPS {max(group) + 1}",
        f"static const int GROUP[STATES] = {{{', '.join(map(str, group))}}};",
        f"static const char SEES[STATES][STATES] = {{{', '.join(rows)}}};",
    ]
