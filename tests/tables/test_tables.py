"""Tables in every backend: the same values and derivatives everywhere, and those of scipy."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import sympy
import torch
from scipy.interpolate import CubicSpline, PchipInterpolator, RegularGridInterpolator

from gbspec.backends.latex.page import document
from gbspec.backends.module import load_module
from gbspec.ir import Curve, Interpolation, lookup, without_values
from gbspec.ir.derivatives import derivative
from gbspec.report.html.mathml import expression
from tests import quick as quickly
from tests.backends.same_kernel import compare, compare_jacobians
from tests.backends.test_agreement import check_agreement, check_derivatives, check_step
from tests.backends.test_native import random_problem
from tests.exports.texts import exported, model_of
from tests.strategies import Point
from tests.tables.texts import EVERY_KIND

PLACES, VALUES = (0.0, 0.3, 0.7, 1.1, 1.6), (0.2, 0.9, 1.1, 1.05, 1.4)
INSIDE = np.linspace(0.0, 1.6, 33)
BEYOND = np.array([-3.0, -1e-9, 1.7, 40.0])


@pytest.mark.parametrize("kind", ["linear", "pchip", "cubic"])
def test_values_are_those_of_scipy(kind: Interpolation) -> None:
    reference = {
        "linear": lambda x: np.interp(x, PLACES, VALUES),
        "pchip": PchipInterpolator(PLACES, VALUES),
        "cubic": CubicSpline(PLACES, VALUES),
    }[kind]
    curve = Curve((PLACES,), VALUES, kind)
    assert curve.value((0,), INSIDE) == pytest.approx(reference(INSIDE), abs=1e-14)
    assert curve.value((0,), BEYOND).tolist() == pytest.approx([VALUES[0], VALUES[0], VALUES[-1], VALUES[-1]])
    assert curve.value((1,), BEYOND).tolist() == [0.0] * 4
    if kind != "linear":
        assert curve.value((1,), INSIDE[:-1]) == pytest.approx(reference(INSIDE[:-1], 1), abs=1e-12)


@pytest.mark.parametrize("values", [(1.0, 3.0), (1.0, 3.0, 2.0), (0.0, 0.0, 1.0, 1.0, 5.0), (5.0, 0.0, 4.9, 5.0, 5.0)])
def test_pchip_of_few_and_of_flat_points(values: tuple[float, ...]) -> None:
    places = PLACES[: len(values)]
    x = np.linspace(places[0], places[-1], 50)
    wanted = PchipInterpolator(places, values)(x) if len(values) > 2 else np.interp(x, places, values)
    assert Curve((places,), values, "pchip").value((0,), x) == pytest.approx(wanted, abs=1e-14)


def test_a_grid_of_two_arguments() -> None:
    x, y = (0.0, 1.0, 2.0, 3.5), (0.0, 0.5, 2.0, 3.0, 4.0)
    table = np.array([[a * a * b + b**3 for b in y] for a in x])
    curve = Curve((x, y), tuple(table.ravel().tolist()), "cubic")
    points = np.random.default_rng(0).uniform(0, 3.5, (50, 2))
    wanted = points[:, 0] ** 2 * points[:, 1] + points[:, 1] ** 3  # a cubic spline through a cubic is this cubic
    assert curve.value((0, 0), *points.T) == pytest.approx(wanted, abs=1e-12)
    assert curve.value((1, 1), *points.T) == pytest.approx(2 * points[:, 0], abs=1e-12)
    flat = Curve((x, y), tuple(table.ravel().tolist()))
    assert flat.value((0, 0), *points.T) == pytest.approx(RegularGridInterpolator((x, y), table)(points), abs=1e-12)


def test_outside_error_has_no_value_beyond_the_points() -> None:
    curve = Curve((PLACES,), VALUES, "pchip", "error")
    assert np.isnan(curve.value((0,), BEYOND)).all()
    assert np.isfinite(curve.value((0,), np.array([0.0, 1.6]))).all()


def test_derivatives_are_tables_of_higher_order() -> None:
    x = sympy.Symbol("x", real=True)
    f = lookup("f", Curve((PLACES,), VALUES, "cubic"))
    slope = derivative(f(x**2), x)
    assert slope == f(x**2).diff(x)
    assert float(slope.subs(x, 0.6)) == pytest.approx(1.2 * CubicSpline(PLACES, VALUES)(0.36, 1))
    assert derivative(derivative(derivative(derivative(f(x), x), x), x), x) == 0


def test_bounds_and_directions() -> None:
    assert Curve((PLACES,), VALUES).direction(0) == 0
    rising = Curve((PLACES,), tuple(sorted(VALUES)), "pchip")
    assert (rising.direction(0), rising.bounds) == (1, (0.2, 1.4))
    wave = Curve((PLACES,), VALUES, "cubic")
    fine = wave.value((0,), np.linspace(0, 1.6, 4001))
    assert wave.bounds[0] <= fine.min() and wave.bounds[1] == pytest.approx(fine.max(), abs=1e-6)


POINT = Point(0.3, np.array([0.83, 1.21]), np.array([1.3]), np.array([0.4]), np.array([1.7]))


def test_torch_casadi_and_numpy_agree() -> None:
    model = model_of(EVERY_KIND)
    check_agreement(model, POINT, 3)
    check_derivatives(model, POINT, 3)
    check_step(model, POINT, 3)


def test_places_and_ends_have_the_same_slopes_in_torch_and_casadi() -> None:
    model = model_of(EVERY_KIND)
    for x, y in ((0.0, 0.0), (0.8, 1.0), (2.0, 2.5), (-0.1, 3.0)):
        check_derivatives(model, Point(0.3, np.array([x, y]), POINT.condition, POINT.inputs, POINT.constants), 3)


def test_the_kernel_agrees_with_the_graph(kernels: Path) -> None:
    with quickly.kernels(kernels):
        problem, parameters, theta = random_problem(model_of(EVERY_KIND), 4)
        compare(problem, parameters, theta, ("float64", "float32"))
        compare_jacobians(problem, parameters, theta)


@pytest.mark.skipif(not (shutil.which("cc") or shutil.which("gcc")), reason="there is no C compiler on this machine")
def test_c_agrees(tmp_path: Path) -> None:
    from tests.exports.test_c import agree

    agree(exported(model_of(EVERY_KIND)), tmp_path)


def test_onnx_agrees() -> None:
    pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")
    from gbspec.exports import ExportOptions
    from gbspec.exports.onnx import make

    for precision, tolerance in (("float64", 1e-12), ("float32", 1e-5)):
        made = make(exported(model_of(EVERY_KIND)), ExportOptions(precision=precision))  # type: ignore[arg-type]
        assert max(one.error for one in made.checked) < tolerance


def test_a_lost_value_is_nan_in_torch_and_its_gradient_elsewhere_is_not() -> None:
    text = "model m\nstate x\ntable f(x) = (0, 1), (1, 3) outside error\nx' = if(x > 1, x, f(x))\nobserve x\n"
    instance = load_module(model_of(text))()
    x = torch.tensor([[0.5], [2.0]], dtype=torch.float64, requires_grad=True)
    found = instance.rhs(0.0, x)
    assert found.tolist() == [[2.0], [2.0]]
    (slope,) = torch.autograd.grad(found.sum(), x)
    assert slope.tolist() == [[2.0], [1.0]]
    alone = load_module(model_of(text.replace("if(x > 1, x, f(x))", "f(x)")))()
    assert np.isnan(float(alone.rhs(0.0, [2.0])[0]))


def test_tables_are_typeset_by_their_names() -> None:
    model = model_of(EVERY_KIND)
    assert r"\mathrm{linear}_{1}\left(y\right)" in document(model)
    assert "9, cubic" in document(model)
    assert "linear" in expression(model.channels[1].value) and "table_" not in expression(model.channels[1].value)
    assert "spline2(y, x)" in str(model.channels[1].value)


def test_arrays_look_up_all_elements_at_once() -> None:
    text = "model row\nstate c[1..4] in [0, 1]\ntable f(x) = (0, 1), (0.4, 3), (1, 0) pchip\nlearn k = 1\n"
    text += "c[i]' = k*f(c[i]) - c[i]\nobserve c[2]\n"
    model = model_of(text)
    at = Point(0.0, np.array([0.1, 0.5, 0.9, 1.2]), np.zeros(0), np.zeros(0), np.array([1.5]))
    check_agreement(model, at, 1)
    check_derivatives(model, at, 1)


def test_tables_without_values_beyond_their_points_are_named_where_a_solution_ends() -> None:
    held = "model m\nstate x in [0, 1] = 0.5\ntable f(v) = (0, 1), (1, 3)\nx' = f(x)\nobserve x\n"
    strict = model_of(held.replace("(1, 3)", "(1, 3) outside error"))
    assert without_values({t.name: t.curve for t in model_of(held).tables}) == ""
    said = without_values({t.name: t.curve for t in strict.tables})
    assert said == "`f` has no value outside of [0, 1] (`outside error`)"
