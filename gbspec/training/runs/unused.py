"""Options that were given and that a fit did not use."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

from gbspec.ir import Model
from gbspec.training.options import TrainOptions
from gbspec.training.stages import StageName


class _Use(NamedTuple):
    """What a fit must have for an option to matter, by its model, the names of its stages and its options, and what to
    say."""

    option: str
    matters: Callable[[Model, Collection[str], TrainOptions], bool]
    why: str


def _with_weights(model: Model, stages: Collection[str], options: TrainOptions) -> bool:
    return bool(model.networks)


def _by_squares(model: Model, stages: Collection[str], options: TrainOptions) -> bool:
    return not model.marginal


def _counted(model: Model, stages: Collection[str], options: TrainOptions) -> bool:
    return options.method in ("adam", "lbfgs", "lm") and not model.marginal


NO_WEIGHTS = "the model has no unknown function, and so no weights"
LIKELIHOOD = "what is distributed, or a learned noise, is fitted by its likelihood"
USES = (
    _Use("ridge", _with_weights, NO_WEIGHTS),
    _Use("output_scale", _with_weights, NO_WEIGHTS),
    _Use("quadrature", lambda model, *_: bool(model.distributed), "no constant has a distribution (`~`)"),
    _Use("learning_rate", lambda _, stages, __: StageName.ADAM.value in stages, "there was no stage `adam`"),
    _Use("method", _by_squares, LIKELIHOOD),
    _Use("forcing", _by_squares, LIKELIHOOD),
    _Use("epochs", _counted, "only `--method adam`, `lbfgs` and `lm` take a number of epochs, and no likelihood does"),
    _Use(
        "initial",
        lambda _, stages, options: options.initial != "bred" or StageName.BREEDING.value in stages,
        "no start was learned",
    ),
)


def said_of_unused(options: TrainOptions, model: Model, stages: Collection[str]) -> list[str]:
    """A sentence for each option that is not as by default and did not matter."""
    usual = TrainOptions()
    return [
        f"`--{use.option.replace('_', '-')}` had no effect: {use.why}"
        for use in USES
        if getattr(options, use.option) != getattr(usual, use.option) and not use.matters(model, stages, options)
    ]
