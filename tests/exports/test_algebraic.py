"""Algebraic variables in C libraries and functional mock-up units: the same solutions as the generated module's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.backends import Evaluator
from gbspec.data import Signal
from gbspec.diagnostics import Findings
from gbspec.exports import ExportOptions
from gbspec.exports.checking import Reference, draw
from gbspec.exports.onnx import make as make_onnx
from gbspec.exports.programs import NotCoveredError, Programs
from gbspec.frontend import load_model
from gbspec.operations import models
from tests.algebraic.models import ARRAY, BUFFER, TWO_ROOTS, UNKNOWN
from tests.exports.test_c import COMPILER, agree, simulated_by_c
from tests.exports.test_fmu import VERSIONS, Version, begin, fmpy, opened, problems, unit
from tests.exports.texts import exported, model_of

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")

CHOSEN = """model chosen
time t from 0
state x in [0.5, 2] = 1
input u in [0, 1] = 0.5 held
learn a = 0.7 in [0.1, 2]
unknown phi(y, x) by mlp(3)
algebraic y in [0, 5] = 1
algebraic w in [-9, 9] = 0
x' = 0.3*u - 0.2*y + if(w > 0.8, 0.5, 0.1)*phi
equation one: y^3 + a*y = x + 0.1*w + 0.05*phi
equation two: w = tanh(y) + 0.2*w*y*x + 0.1*t
observe x
observe both = y*w
"""
"""Two equations solved together that apply an unknown, and a choice that depends on their solution."""


def bundled(name: str = "buffered_tank"):  # type: ignore[no-untyped-def]
    return exported(load_model(name, Findings()))


@pytest.mark.parametrize("text", [BUFFER, UNKNOWN, ARRAY])
def test_the_library_solves_equations(text: str, tmp_path: Path) -> None:
    compiled = agree(exported(model_of(text)), tmp_path)
    assert "_algebraic(const" in compiled.library.header()


def test_the_bundled_model(tmp_path: Path) -> None:
    agree(bundled(), tmp_path)
    simulated_by_c(models.subject("buffered_tank", {}, Findings()), tmp_path / "library")


def test_the_branch_is_that_of_the_module(tmp_path: Path) -> None:
    """Of two solutions that which the search finds from the start; without any it is no number, and this is told."""
    compiled = agree(exported(model_of(TWO_ROOTS)), tmp_path)
    points = draw(compiled.library.exported, 3)
    points.x[:, 0] = [4.0, 2.25, -1.0]
    found = compiled.values("algebraic", points, 1)[:, 0]
    assert found[:2] == pytest.approx([2.0, 1.5], rel=1e-15) and np.isnan(found[2])
    assert np.isnan(compiled.values("rhs", points, 1)[2, 0])


@VERSIONS
@pytest.mark.parametrize("text", [UNKNOWN, CHOSEN])
def test_units_have_values_and_derivatives(text: str, version: Version, tmp_path: Path) -> None:
    subject = exported(model_of(text))
    path = unit(subject, version, tmp_path)
    assert problems(path) == []
    one, model, points = opened(path), subject.model, draw(subject, 4)
    known = Reference(subject, Programs(model, algebraics=True), points)
    begin(one)
    given = [*(s.name for s in model.states), *(i.name for i in model.inputs), *model.constant_names]
    knowns, time = [one.refs[name] for name in given], one.refs[model.time.name]
    asked = [one.refs[f"der({s.name})"] for s in model.states] + [one.refs[c.name] for c in model.channels]
    solved = [one.refs[item.name] for item in model.algebraics]
    for i, (t, x, _, *parts) in enumerate(zip(*points.arguments, strict=True)):
        one.unit.setTime(t)
        one.put(knowns, np.concatenate([x, *parts]).tolist())
        values = np.concatenate([known.rhs[0][i], known.observe[0][i], known.algebraics[0][i]])
        assert one.get([*asked, *solved]) == pytest.approx(values, rel=1e-13, abs=1e-13)
        dt, dx, _, *along = (part[i] for part in points.along)
        seed = [*np.concatenate([dx, *along]).tolist(), float(dt)]
        found = np.array(one.unit.getDirectionalDerivative([*asked, *solved], [*knowns, time], seed))
        slopes, terms = (
            np.concatenate([a[i], b[i]]) for a, b in zip(known.rhs_along, known.observe_along, strict=True)
        )
        assert (np.abs(found[: len(asked)] - slopes) <= 1e-12 * terms).all()
        assert np.isfinite(found).all()


@VERSIONS
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_the_bundled_unit_follows_the_module(kind: str, version: Version, tmp_path: Path) -> None:
    subject = bundled()
    path = unit(subject, version, tmp_path)
    assert problems(path) == [] and path.stat().st_size < 200_000
    outputs = ["acid", "sodium", "pH"]
    found = fmpy.simulate_fmu(
        str(path), fmi_type=kind, output=outputs, start_values={"base": 400.0}, stop_time=0.5, output_interval=0.1,
        solver="CVode", relative_tolerance=1e-11,
    )  # fmt: skip
    evaluator, times = Evaluator(subject.instance), found["time"]
    x0, inputs = evaluator.initial(subject.states), (Signal(np.zeros(1), np.array([400.0])),)
    if kind == "ModelExchange":
        known, accepted = evaluator.integrate(x0, times, (), inputs, 0.0), 1e-7
    else:
        known, accepted = evaluator.integrate_fixed(x0, times, (), inputs, 0.0, max_step=0.01), 1e-12
    states = np.stack([found[name] for name in outputs[:2]], axis=1)
    assert np.abs(states - known).max() <= accepted * np.abs(known).max()
    solved = evaluator.algebraics_many(times, known, (), [400.0])[:, 0]
    assert np.abs(found["pH"] - solved).max() <= 10 * accepted * np.abs(solved).max()


@VERSIONS
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_a_choice_that_depends_on_a_solution(kind: str, version: Version, tmp_path: Path) -> None:
    subject = exported(model_of(CHOSEN))
    path = unit(subject, version, tmp_path)
    found = fmpy.simulate_fmu(
        str(path), fmi_type=kind, output=["x", "w"], start_values={"solver.step": 0.01, "u": 0.0}, stop_time=6.0,
        output_interval=0.75, solver="CVode", relative_tolerance=1e-11, record_events=False,
    )  # fmt: skip
    evaluator = Evaluator(subject.instance)
    inputs = (Signal(np.zeros(1), np.zeros(1)),)
    known = evaluator.integrate(subject.states, found["time"], (), inputs, 0.0)
    assert found["w"][0] < 0.8 < found["w"][-1], "the choice changed"
    assert np.abs(found["x"] - known[:, 0]).max() <= (1e-7 if kind == "ModelExchange" else 1e-3)


def test_graphs_are_refused_with_the_reason() -> None:
    with pytest.raises(NotCoveredError, match="algebraic variables"):
        make_onnx(bundled(), ExportOptions())
