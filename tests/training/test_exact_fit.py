"""Fits without any residual, whose equations are singular and whose expected decrease is nothing but rounding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.training.optimise.normal_equations import Cholesky, NormalEquations

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """\
model m
state x in [0, 2]
learn k = 1 in [0, 2]
x' = -k*x
initial x = 1
observe x
"""


def singular(*_: object) -> float:
    """What the factorisation does where the damping is lost in the rounding of a singular matrix."""
    Cholesky(np.array([[1.0, 2.0], [2.0, 1.0]]))
    raise AssertionError("it is not positive definite")


def test_a_fit_ends_without_an_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NormalEquations, "invert", singular)
    (tmp_path / "m.gb").write_text(TEXT)
    rows = "".join(f"{t},{2.718281828 ** (-0.5 * t)}\n" for t in (0.1, 0.2, 0.4, 0.8))
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", threads=1).run.fit
    assert fit.constants["k"].interval is None and fit.constants["k"].sd is None


def test_a_decrease_that_was_not_predicted_ends_no_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NormalEquations, "predicted_decrease", lambda self, step: -1e-30)
    (tmp_path / "m.gb").write_text(TEXT)
    (tmp_path / "d.csv").write_text("t,x\n0,1\n0.1,0.951\n0.2,0.904\n0.4,0.819\n0.8,0.670\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", threads=1).run.fit
    assert abs(fit.constants["k"].value - 0.5) < 0.01


def test_equations_that_say_nothing_about_the_prior_leave_it_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(NormalEquations, "degrees_of_freedom", singular)
    (tmp_path / "m.gb").write_text(
        TEXT.replace("learn k = 1 in [0, 2]", "unknown r(x) by mlp(3)").replace("k*x", "r(x)")
    )
    rows = "".join(f"{t / 10},{2.718281828 ** (-0.05 * t)}\n" for t in range(1, 20))
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", threads=1).run.fit
    assert fit.members[0].rmse["x"] < 0.1
