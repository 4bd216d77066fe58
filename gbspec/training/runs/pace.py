"""How long a fit may still take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gbspec.runs import StageRecord
from gbspec.training.stages import StageName

SEARCHES = frozenset({StageName.SEARCH, StageName.SEARCH_STARTS, StageName.JUMPS})
"""Stages each of whose iterations is a whole fit; most of those of the first two end after the first few."""
LIKELIHOODS = frozenset({StageName.MARGINAL, StageName.OTHER_MAXIMA, StageName.QUADRATURE})
"""Stages of populations, each of whose iterations seeks the constants of all trajectories."""
TYPICAL = 0.15
"""The share of the largest numbers of iterations that is expected before a stage has ended: the median of 431 fits of
least squares was 0.135, 0.015 to 0.41 in four of five."""
INNOVATIONS = 40
"""So many iterations the likelihood of innovations may need, whatever their largest number: 26 to 57 in 50 fits without
unknown functions (median 30), of which 24 compare starts. With these a second fit follows, and 130 were needed too."""


def seconds_left(
    before: Sequence[StageRecord],
    now: StageRecord,
    totals: Mapping[str, int],
    later: Sequence[str],
    functions: bool = False,
) -> float | None:
    """An estimate for the stage `now`, as far as it is, and the stages `later`; None where nothing tells their pace.

    Most stages converge long before their last iteration: the share that those of several iterations needed so far,
    or that fits typically need, is expected of the others, at the pace that these had. Iterations of searches, of least
    squares and of populations have nothing in common, so that each kind is estimated by itself. `totals` has the
    largest numbers by stage; `functions`: some are learned.
    """
    if now.name == StageName.INNOVATIONS:  # the only one of several iterations
        more = min(INNOVATIONS, totals[now.name]) - now.iterations
        return None if functions or more <= 0 else now.seconds / max(now.iterations, 1) * more
    marginal = StageName.MARGINAL in totals

    def kind(name: str) -> str:
        if name in SEARCHES:
            return "search"
        # With a finer step a population's likelihood goes on.
        return "likelihood" if name in LIKELIHOODS or (marginal and name == StageName.FINER) else "least squares"

    left = 0.0
    for each in dict.fromkeys(map(kind, (now.name, *later))):
        several = [one for one in before if kind(one.name) == each and totals.get(one.name, 1) > 1 and one.iterations]
        running = now if kind(now.name) == each and totals[now.name] > 1 else None
        part = _of_kind(several, running, totals, sum(totals[name] for name in later if kind(name) == each))
        # Of a first search, or a first likelihood, the largest number of iterations tells nothing.
        if part is None or (each != "least squares" and not several):
            return None
        left += part
    return left


def _of_kind(
    before: Sequence[StageRecord], now: StageRecord | None, totals: Mapping[str, int], rest: int
) -> float | None:
    """The estimate for stages of one kind: the running one, and at most `rest` iterations of later ones."""
    own = 0 if now is None else max(totals[now.name] - now.iterations, 0)
    pace = 0.0 if now is None else now.seconds / max(now.iterations, 1)
    if before:
        iterations = sum(one.iterations for one in before)
        share = min(iterations / sum(totals[one.name] for one in before), 1.0)
        return share * (pace * own + sum(one.seconds for one in before) / iterations * rest)
    return None if now is None and rest else TYPICAL * pace * (own + rest)
