"""Where a profile is computed on one side of the estimate, so that few points find where it crosses its threshold.

Places are distances from the estimate, in any unit; roots are those of the deviance over the threshold's, which are
linear for a parabola. The crossing lies where the root is 1.
"""

from __future__ import annotations

from typing import NamedTuple

FIRST, BEYOND = 0.6, 1.05
"""Target values of the root: first well inside, then just outside."""
CLOSE = 0.1
"""A side is complete where the root at one end of the bracket is within this of 1: a straight line between the two ends
is then off by a fraction of it."""
NARROW = 0.05
"""It is also complete where the bracket is narrower than this share of its distance: the root jumps there."""
EDGE = 0.25
"""A new place keeps this share of the bracket from its ends."""


class Known(NamedTuple):
    """A place, and the root of the deviance there."""

    place: float
    root: float


def closely(inside: Known, outside: Known) -> bool:
    """Whether a straight line between two places says where the root is 1."""
    near = min(outside.root - 1.0, 1.0 - inside.root)
    return near <= CLOSE or outside.place - inside.place <= NARROW * outside.place


class Side:
    """The search for the crossing: `next` is the place to compute, `tell` what was found there."""

    def __init__(self) -> None:
        self.before = self.inside = Known(0.0, 0.0)
        self.outside: Known | None = None
        self._told: list[bool] = []  # whether each was inside

    def tell(self, place: float, root: float) -> None:
        """Notes the root at a place."""
        if root > 1.0:
            self.outside = Known(place, root)
        else:
            self.before, self.inside = self.inside, Known(place, root)
        self._told.append(root <= 1.0)

    @property
    def complete(self) -> bool:
        """Whether the crossing is known closely."""
        return self.outside is not None and closely(self.inside, self.outside)

    @property
    def next(self) -> float:
        """The next place: further out until a point lies outside, then between the two that enclose the crossing."""
        if not self._told:
            return FIRST
        if self.outside is None:
            return self._further()
        (near, low), (far, high) = self.inside, self.outside
        share = (1.0 - low) / (high - low)
        if len(self._told) > 2 and self._told[-1] == self._told[-2]:
            share = 0.5  # straight lines of a bent root keep one end for ever
        return near + min(max(share, EDGE), 1.0 - EDGE) * (far - near)

    def _further(self) -> float:
        """The place beyond two others inside, by the root's rise between them: at most twice as far. A root that bends
        down would be approached in ever smaller steps by its rise from the estimate on."""
        here, last = self.inside, self.before
        rise = (here.root - last.root) / (here.place - last.place)
        return min(here.place + (BEYOND - here.root) / max(rise, 1e-9), 2.0 * here.place)
