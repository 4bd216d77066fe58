"""Planning of adaptive steps and frozen matrices by torch."""

from __future__ import annotations

import torch

from gbspec.arrays import Array
from gbspec.training.engines.torch.control import Walk
from gbspec.training.engines.torch.interrupted import InterruptedWalk
from gbspec.training.problem import Parameters, Path, Problem, meshed


def planned(problem: Problem, parameters: Parameters, theta: Array, path: Path) -> Path:
    """The path with the steps and matrices of the solution at a vector."""
    kind = InterruptedWalk if problem.model.events else Walk
    with torch.no_grad():
        return meshed(path, kind(problem, parameters, torch.from_numpy(theta), path).run())
