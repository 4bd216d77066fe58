"""The start from an earlier run: its networks and its constants, matched by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model
from gbspec.runs import open_run
from gbspec.training.problem import Weights


@dataclass(frozen=True)
class Earlier:
    """What an earlier run has of a model: weights with the scales of their networks, and constants in their units."""

    weights: Weights
    constants: dict[str, float]

    def natural(self, model: Model, otherwise: Array) -> Array:
        """The learnable constants, from `otherwise` [..., n] where the run has none or one out of its bounds."""
        found = [self.constants.get(k.name, np.nan) for k in model.learnables]
        inside = [k.range.low < value < k.range.high for k, value in zip(model.learnables, found, strict=True)]
        return np.where(inside, found, otherwise)


def earlier(path: str | Path, model: Model, module: type[GeneratedModule]) -> Earlier:
    """What the run at `path` has of the model: networks of the same name, constants of the same name.

    Raises UserError: what `open_run` says of a directory that is no usable run, and GB867 if nothing has the same name
    or a network has another shape.
    """
    run = open_run(Path(path))
    there = run.member(run.best)
    wanted = {name: shape for name, shape in module.shapes().items() if name.startswith("network.")}
    weights = {name: np.asarray(there.weights[name]) for name in wanted if name in there.weights}
    other = sorted({name.split(".")[1] for name, value in weights.items() if value.shape != wanted[name]})
    if other:
        raise _refused(path, f"network `{other[0]}` has other layers there than in `{model.name}`")
    table = dict(zip(there.constants, np.asarray(there.weights["constants"], dtype=np.float64), strict=False))
    constants = {k.name: float(table[k.name]) for k in model.learnables if k.name in table}
    if not weights and not constants:
        raise _refused(path, f"it has neither networks nor constants of `{model.name}`")
    return Earlier(weights, constants)


def _refused(path: str | Path, reason: str) -> UserError:
    help = "`--start` takes a run of the same model, or of one with the same networks; without it no run is needed"
    return UserError([Diagnostic("GB867", f"a fit cannot start from `{path}`: {reason}", None, help=help)])
