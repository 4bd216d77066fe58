"""Options that were given and that a fit did not use."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

from gbspec.ir import Model
from gbspec.training.options import TrainOptions
from gbspec.training.stages import StageName


class _Use(NamedTuple):
    """What a fit must have for an option to matter, by its model and the names of its stages, and what to say."""

    option: str
    matters: Callable[[Model, Collection[str]], bool]
    why: str


def _with_weights(model: Model, stages: Collection[str]) -> bool:
    return bool(model.networks)


def _with_adam(model: Model, stages: Collection[str]) -> bool:
    return StageName.ADAM.value in stages


NO_WEIGHTS = "the model has no unknown function, and so no weights"
USES = (
    _Use("ridge", _with_weights, NO_WEIGHTS),
    _Use("output_scale", _with_weights, NO_WEIGHTS),
    _Use("quadrature", lambda model, stages: bool(model.distributed), "no constant has a distribution (`~`)"),
    _Use("learning_rate", _with_adam, "there was no stage `adam`"),
)


def said_of_unused(options: TrainOptions, model: Model, stages: Collection[str]) -> list[str]:
    """A sentence for each option that is not as by default and did not matter."""
    usual = TrainOptions()
    return [
        f"`--{use.option.replace('_', '-')}` had no effect: {use.why}"
        for use in USES
        if getattr(options, use.option) != getattr(usual, use.option) and not use.matters(model, stages)
    ]
