"""Comparison of the native kernel with the torch graph."""

from __future__ import annotations

import numpy as np
import torch

from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.engines.objective import linearise, objective
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem

DOUBLE, SINGLE = 1e-12, 1e-5


def compare(problem: Problem, parameters: Parameters, theta: np.ndarray, precisions: tuple[str, ...]) -> None:
    """Asserts that loss and gradient of kernel and graph agree, relative to the largest entry."""
    loss, gradient = objective(problem, parameters, "torch")(theta)
    assert np.isfinite(loss)
    for precision in precisions:
        found = objective(problem, parameters, "native", precision)(theta)  # type: ignore[arg-type]  # a literal
        bound = DOUBLE if precision == "float64" else SINGLE
        assert abs(found[0] - loss) <= bound * max(abs(loss), 1e-300)
        assert np.abs(found[1] - gradient).max() <= bound * np.abs(gradient).max()
    compare_jacobians(problem, parameters, theta)


def compare_jacobians(problem: Problem, parameters: Parameters, theta: np.ndarray) -> None:
    """Asserts that the Jacobians of the residuals by kernel and graph agree, relative to the largest entry."""
    kernel = kernel_of(problem.model, type(problem.module))
    assert isinstance(kernel, Kernel)
    engines = TorchEngine(problem, parameters), NativeEngine(problem, parameters, kernel)
    graph, ours = (linearise(engine, theta) for engine in engines)
    for of_graph, of_kernel in ((graph.shared, ours.shared), (graph.local, ours.local)):
        assert of_graph.shape == of_kernel.shape
        if of_graph.numel():
            assert float((of_graph - of_kernel).abs().max()) <= 1e-11 * float(of_graph.abs().max())
    assert torch.equal(graph.owner, ours.owner)
