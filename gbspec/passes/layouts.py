"""Layouts of networks: which units may depend on which arguments, so that the outputs have their directions.

Every unit has a kind, one character per argument: `+` (not decreasing in it), `-`, `x` (convex), `c` (concave), `p`
and `q` (convex and rising or falling), `r` and `s` (concave and so), `*` (freely), `0` (not at all). A weight from a
unit of kind a to one of kind b may be positive if every property of a is allowed by b, negative if every reversed one
of a is, of either sign if both, and is absent if neither: by induction over the layers each unit then depends on the
arguments according to its kind, provided that the units in between are rising functions of their inputs, and bent as
their kinds say.

Units that must be convex in an argument have rising convex activations, and those that must be concave rising concave
ones. Other units whose kind has a direction get monotone activations: some convex, some concave, some saturating (Runje
and Shankaranarayana, "Constrained monotonic neural networks", ICML 2023). A single layer has a third of each, as
every second one of several, after one with convex and concave units; where there are other units too, monotone ones
only bend. A layer of saturating units alone would bound the output: where all of them are saturated it is constant,
and whatever goes on rising there is out of reach. Other units keep the network's activation.
"""

from __future__ import annotations

from collections.abc import Sequence

from gbspec.ir import Block, Layout, Shape

TURNED = str.maketrans("+-xcpqrs", "-+cxsrqp")
DIRECTED = "+-xcpqrs"
CONVEX, CONCAVE = frozenset("xpq"), frozenset("crs")
SHAPES: tuple[Shape, ...] = ("free", "convex", "concave", "saturating")
_THIRDS: tuple[Shape, ...] = ("convex", "concave", "saturating")
_BENDS: tuple[Shape, ...] = ("convex", "concave")


class TooNarrow(Exception):  # noqa: N818 - not an error: reported with the place of the network
    """A hidden layer has fewer units than there are kinds; `needed` is the least width."""

    def __init__(self, needed: int) -> None:
        self.needed = needed
        super().__init__(f"at least {needed} units are needed")


def layout(kinds: Sequence[str], hidden: Sequence[int], gates: int) -> Layout | None:
    """The layout for outputs of the given kinds (those of the extra outputs last); None if all are free and declared.

    Raises:
        TooNarrow: a hidden layer cannot have a unit of every kind.
    """
    if not gates and all(set(kind) <= {"*"} for kind in kinds):
        return None
    groups = _groups(kinds)
    needed = sum(share for _, share in groups)
    if any(width < len(groups) for width in hidden):
        raise TooNarrow(len(groups))
    mixed = any(not monotone(kind) for kind, _ in groups)
    layers = []
    for i, width in enumerate(hidden):
        bent = len(hidden) > 1 and (mixed or i % 2 == 0)
        shapes = _BENDS if bent else _THIRDS
        layers.append(_blocks(groups, needed, width, shapes))
    return Layout(tuple(layers), tuple(kinds), gates)


def monotone(kind: str) -> bool:
    """Whether a unit of that kind needs a monotone activation."""
    return any(letter in DIRECTED for letter in kind)


def kind_of(direction: int, curvature: int) -> str:
    """The character of an argument in which a unit goes up or down (1, -1), and is convex or concave (1, -1)."""
    rows = {0: "*+-", 1: "xpq", -1: "crs"}
    return rows[curvature][direction]


def _groups(kinds: Sequence[str]) -> list[tuple[str, int]]:
    """Kinds of hidden units with their shares: those of the outputs, and those for their free arguments."""
    found: dict[str, int] = {}
    for kind in kinds:
        if kind.translate(TURNED) not in found:  # reversed, it is the same unit with the opposite sign
            found[kind] = 2
    for kind in kinds:
        free = kind.translate(str.maketrans(DIRECTED, "0" * len(DIRECTED)))
        if monotone(kind) and "*" in free:
            found.setdefault(free, 1)
    return list(found.items())


def _blocks(groups: Sequence[tuple[str, int]], total: int, width: int, shapes: tuple[Shape, ...]) -> tuple[Block, ...]:
    """A layer's units: its share for each kind, divided evenly among the shapes for monotone kinds."""
    counts = [max(1, width * share // total) for _, share in groups]
    while sum(counts) > width:
        counts[counts.index(max(counts))] -= 1
    counts[0] += width - sum(counts)
    blocks = []
    for (kind, _), count in zip(groups, counts, strict=True):
        if not monotone(kind):
            blocks.append(Block(kind, "free", count))
            continue
        fitting = _bent(kind) or shapes
        for i, shape in enumerate(fitting):
            part = count // len(fitting) + (i >= len(fitting) - count % len(fitting))
            blocks += [Block(kind, shape, part)] if part else []
    return tuple(sorted(blocks, key=lambda block: SHAPES.index(block.shape)))


def _bent(kind: str) -> tuple[Shape, ...]:
    """The only activation of units that must be convex or concave in an argument; empty for others."""
    if CONVEX & set(kind):
        return ("convex",)
    return ("concave",) if CONCAVE & set(kind) else ()
