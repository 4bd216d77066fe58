"""Derivatives that an evaluation does not know: where right-hand sides jump, and steps do not end there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gbspec.ir import Model
from gbspec.passes import Switched
from gbspec.training.recipe import of_solutions


@dataclass(frozen=True)
class Lacking:
    """The constants by which there is no derivative, and why; both empty where all are known."""

    names: tuple[str, ...] = ()
    reason: str = ""

    @classmethod
    def of(cls, model: Model, switched: Switched, slides: bool) -> Lacking:
        """What is lacking of a model with these switches; `slides`: whether steps go across some of them.

        The time of a jump moves with all that moves the solution. Residuals at modes, and a filter's variances, then
        depend on everything.
        """
        sliding = "solutions slide along such a place, or touch it" if slides and switched.jumps else ""
        reason = switched.unknown_jumps or sliding
        if not reason:
            return cls()
        integral = model.distributed or model.diffusions
        names = (*(k.name for k in model.learnables), *(k.name for k in model.implied))
        return cls(names if integral else of_solutions(model), reason)

    def without(self, gradient: Mapping[str, float]) -> dict[str, float]:
        """A gradient with NaN in the place of what is lacking."""
        return {name: float("nan") if name in self.names else slope for name, slope in gradient.items()}
