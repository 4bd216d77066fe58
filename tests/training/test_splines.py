"""Splines in fits: what they can be, the prior of their second differences, and the kernel."""

from __future__ import annotations

import numpy as np

from gbspec.backends import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.report.text import model_summary
from gbspec.training.engines import objective
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.optimise.priors import SMOOTH, Priors
from tests.training.conftest import problem_of, trajectory
from tests.training.reference import whole_jacobian

TEXT = """
model s
state a in [0, 3]
state b in [0, 2]
learn k = 0.7 in [0.1, 3]
unknown f(a) >= 0, increasing in a by spline(7)
unknown g(a, b) by spline(5, 4)
a' = 1 - k*f
b' = 0.5 - b + 0.1*g
observe a
observe b
"""


def model_of(text: str) -> Model:
    return load_model("m.gb", Findings(), lambda path: Source(str(path), text))


def rows() -> Trajectories:
    rng = np.random.default_rng(2)
    items = [trajectory(str(i), 0.0, np.arange(1.0, 4.0), rng.uniform(0.3, 1.0, (3, 2)), []) for i in range(2)]
    return Trajectories(tuple(items), ("a", "b"))


def test_the_kernel_gives_the_same() -> None:
    model = model_of(TEXT)
    problem, parameters, theta = problem_of(model, rows(), 0.2)
    native, graph = NativeEngine(problem, parameters, Kernel(model)), TorchEngine(problem, parameters)
    for one, other in zip(objective.half_squares(native, theta), objective.half_squares(graph, theta), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)
    found, expected = (whole_jacobian(objective.linearise(e, theta), parameters).numpy() for e in (native, graph))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)


def test_second_differences_have_a_prior() -> None:
    model = model_of(TEXT)
    problem, parameters, theta = problem_of(model, rows(), 0.2)
    priors = Priors.of(problem, parameters, np.full(12, 0.1))
    assert len(priors) == (7 - 2) + (5 * 4 - 4)
    entries = theta[priors.column]
    np.testing.assert_allclose(priors.rows(theta), priors.noise * entries / SMOOTH)
    assert (theta[7 : 7 + 7][2:] == entries[:5]).all()
    step = np.zeros_like(theta)
    step[priors.column[3]] = 1e-6
    slope = (priors.penalty(theta + step) - priors.penalty(theta - step)) / 2e-6
    np.testing.assert_allclose(priors.gradient(theta)[priors.column[3]], slope, rtol=1e-6)


def test_without_second_differences_it_is_a_straight_line_held_beyond_the_range() -> None:
    cls = load_module(model_of("model s\nstate a\nunknown f(a in [-1, 3]) by spline(9)\na' = -f\nobserve a\n"))
    weights = dict(cls.random(0).weights)
    weights["network.f.0.bias"] = np.array([0.4, 1.6, *[0.0] * 7])
    function = cls(weights).functions["f"]
    values = np.array([float(function(a)) for a in np.linspace(-1.0, 3.0, 33)])
    np.testing.assert_allclose(np.diff(values, 2), 0, atol=1e-14)
    assert np.diff(values).min() > 0
    assert float(function(-50.0)) == values[0]
    assert float(function(50.0)) == values[-1]


def test_the_summary_names_a_spline() -> None:
    text = "model m\ntime t\nstate x in [0, 1]\nunknown f(x) by spline(6)\nx' = -f(x)\nobserve x\n"
    assert "unknown f(x): cubic spline, 6 coefficients\n" in model_summary(model_of(text))
