"""Steady states, eigenvalues, folds and Hopf points with algebraic variables are those of the reduced equations."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.eigen import eigen
from gbspec.analysis.systems.system import system_of
from gbspec.backends import Evaluator, load_module
from tests.algebraic.models import built

FOLD = """model fold
time t from 0
state x in [-2, 2]
algebraic z in [-3, 3] = 0.5
learn r = 0.4 in [-0.5, 1]
equation same: z + z^3 = x + x^3
x' = r - z^2
observe x
"""
HOPF = """model turning
time t from 0
state x in [-2, 2]
state y in [-2, 2]
algebraic z in [-3, 3] = 0
learn m = 0.2 in [-0.5, 0.5]
equation same: z + exp(z) = x + exp(x)
x' = m*z - y - z*(z^2 + y^2)
y' = x + m*y - y*(z^2 + y^2)
observe x
"""


def test_eigenvalues_are_those_of_the_reduced_system() -> None:
    model = built(HOPF)
    (point,) = eigen(system_of(Evaluator(load_module(model)()), model), at=[{"x": 0.3, "y": -0.2, "m": 0.1}]).points
    x, y, m = 0.3, -0.2, 0.1
    reduced = [[m - 3 * x**2 - y**2, -1 - 2 * x * y], [1 - 2 * x * y, m - x**2 - 3 * y**2]]
    assert point.eigenvalues == pytest.approx(sorted(np.linalg.eigvals(reduced), key=lambda v: (-v.real, -v.imag)))


def test_a_fold_and_a_hopf_point_are_where_they_are_known_to_be() -> None:
    options = BifurcationOptions(values=5, starts=8)
    model = built(FOLD)
    diagram = bifurcate(system_of(Evaluator(load_module(model)()), model), "r", -0.5, 1.0, options)
    (fold,) = diagram.of_kind("fold")
    assert fold.value == pytest.approx(0.0, abs=1e-7)
    model = built(HOPF)
    diagram = bifurcate(system_of(Evaluator(load_module(model)()), model), "m", -0.5, 0.5, options)
    (hopf,) = diagram.of_kind("hopf")
    assert hopf.value == pytest.approx(0.0, abs=1e-7) and hopf.criticality == "super"
