"""What a run says of minima: members that ended in different ones, and a best one that was found once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbspec.ir import Model
from gbspec.runs import last_search
from gbspec.training.optimise import equal
from gbspec.training.runs.summary import MemberResult
from gbspec.training.stages import Effort, StageName
from gbspec.training.starts import CLEARLY, FOLLOWED, WORSE

ROUNDED = 1e-8
"""Losses up to this number are those of exact data, whose ratios say nothing."""
FEW = 1 / 3
"""Where so many of the improved starts end near the best minimum, it is the one that they lead to."""


def said_of_minima(results: Mapping[int, MemberResult]) -> list[str]:
    """A warning where members ended in minima of different depth."""
    losses = _losses(results)
    best = min(losses.values(), default=0.0)
    worse = [member for member, loss in sorted(losses.items()) if loss > max(_bound(results, best), ROUNDED)]
    if not worse:
        return []
    listed = ", ".join(f"{member} (loss {losses[member]:.4g})" for member in worse)
    return [
        f"members ended in different minima: the best loss is {best:.4g}, worse are {listed}. Intervals contain the "
        "differences; a single fit may end in either: trust the best member, or use more of them"
    ]


def found_once(results: Mapping[int, MemberResult], effort: Effort, model: Model | None = None) -> list[str]:
    """A sentence for the best member, where its search has ended by its effort and led to the best minimum once.

    Nothing is said where other members agree with it, where many starts ended near it, or where other minima are named
    already; nor where the search was only for a start: of segments, of unknown functions, of distributed constants.
    """
    losses = _losses(results)
    best = min(losses, key=lambda member: losses[member], default=None)
    start_only = model is not None and bool(model.unknowns)
    if best is None or losses[best] <= FOLLOWED or not results[best].finished or start_only:
        return []
    as_good = [member for member, loss in losses.items() if loss <= _bound(results, losses[best])]
    result, names = results[best], [stage.name for stage in results[best].stages]
    search = last_search(result.stages)
    named = StageName.HORIZONS in names or any(equal.EQUALLY_WELL in note for note in result.notes)
    if search is None or search.times != 1 or len(as_good) > 1 or named or 1 + search.near >= FEW * search.improved:
        return []
    near = f", and {search.near} of the others ended near it" if search.near > 0 else ""
    more = "`--members 5` search" if effort == "high" else "`--effort high` searches"
    return [
        f"member {best}: of {search.improved} starts that were improved one led to the best minimum{near}: there may "
        f"be a better one that none led to. {more} for longer; narrower bounds, or starting values near what is meant, "
        "help too"
    ]


def _losses(results: Mapping[int, MemberResult]) -> dict[int, float]:
    """The losses of the members, where these are what was minimised."""
    return {member: one.loss for member, one in results.items() if one.objective is None and np.isfinite(one.loss)}


def _bound(results: Mapping[int, MemberResult], best: float) -> float:
    """The largest loss of a minimum that is as good as one with the loss `best`."""
    count = max((sum(one.values or 0 for one in r.channels.values()) for r in results.values()), default=0)
    return best * (1 + max(WORSE, CLEARLY / max(count, 1)))
