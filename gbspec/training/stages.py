"""The stages of the estimation: their names, and the largest number of iterations of each by effort.

`gbspec.training.recipe.planning` says when each of them runs; docs/training.md describes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal

Effort = Literal["low", "normal", "high"]


class StageName(StrEnum):
    """The names of stages in options, histories, `fit.json` and checkpoints."""

    WARM_START = "warm start"
    ADAM = "adam"
    IMPUTED = "imputed forcing"
    STARTS = "initial states"
    TEACHER = "teacher forcing"
    STARTS_AGAIN = "initial states again"
    HALF_STEP = "half step"
    WHOLE = "whole solutions"
    HORIZONS = "growing horizons"
    SHORTER = "shorter step"
    BLEND = "blend"
    WHOLE_STARTS = "initial states of whole solutions"
    OTHER_START = "other start"
    AUTOREGRESSIVE = "autoregressive"
    CHOICE = "choice"
    AS_ASKED = "forcing as asked"
    SEARCH = "search"
    LEAST_SQUARES = "least squares"
    SEARCH_STARTS = "search, starts too"
    LEAST_SQUARES_STARTS = "least squares, starts too"
    CUT = "cut steps"
    FINER = "finer step"
    WEIGHTS = "channel weights"
    FURTHER = "further iterations"
    FUNCTIONS = "functions alone"
    POOLED = "pooled fit"
    POOLED_AGAIN = "pooled fit again"
    MARGINAL = "marginal likelihood"
    JUMPS = "times of jumps"
    OTHER_MAXIMA = "other maxima"
    QUADRATURE = "quadrature"
    LBFGS = "lbfgs"
    INNOVATIONS = "innovations"
    BREEDING = "bred initial states"
    LEVENBERG_MARQUARDT = "lm"


UNNAMED = frozenset({StageName.LEVENBERG_MARQUARDT, StageName.WARM_START})
"""Stages that other options select (`--method`, `--no-warm-start`); `--stages` selects among the others."""

MAYBE = frozenset(
    {StageName.SHORTER, StageName.CUT, StageName.FINER, StageName.JUMPS, StageName.OTHER_MAXIMA, StageName.QUADRATURE}
)
"""Stages that run where a check at the end of the others asks for them: not part of the time that is left."""

_MOST: Mapping[str, tuple[int, int, int]] = {
    StageName.ADAM: (15, 25, 60),
    StageName.IMPUTED: (4, 6, 10),
    StageName.TEACHER: (6, 60, 200),
    StageName.HALF_STEP: (0, 30, 100),
    StageName.WHOLE: (0, 100, 200),
    StageName.BLEND: (4, 4, 10),
    StageName.AUTOREGRESSIVE: (8, 100, 200),
    StageName.AS_ASKED: (8, 14, 60),
    StageName.LEAST_SQUARES: (100, 200, 500),
    StageName.LEAST_SQUARES_STARTS: (100, 200, 500),
    StageName.CUT: (20, 50, 100),
    StageName.FINER: (20, 50, 100),
    StageName.WEIGHTS: (8, 30, 60),
    StageName.FURTHER: (0, 0, 120),
    StageName.FUNCTIONS: (20, 40, 100),
    StageName.POOLED: (20, 40, 100),
    StageName.POOLED_AGAIN: (20, 40, 100),
    StageName.MARGINAL: (60, 200, 500),
    StageName.QUADRATURE: (60, 200, 500),
    StageName.INNOVATIONS: (40, 150, 400),
    StageName.LBFGS: (100, 300, 1500),
    StageName.LEVENBERG_MARQUARDT: (6, 60, 200),
}
_EFFORTS: tuple[Effort, ...] = ("low", "normal", "high")


def most_iterations(stage: str, effort: Effort) -> int:
    """The largest number of iterations of a stage; 1 for stages that consist of one step at any effort."""
    return _MOST[stage][_EFFORTS.index(effort)] if stage in _MOST else 1
