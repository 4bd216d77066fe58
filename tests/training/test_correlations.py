"""Correlations of learned constants: those of least squares, and a warning where the data tell two apart badly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.training.runs.constants import moving_together

pytestmark = pytest.mark.usefixtures("quick_fits")

LINE = """\
model line
time t from 0
state x in [-5, 5] = 1
condition u in [0, 1]
learn a = 0.1 in [-5, 5]
learn b = 0.1 in [-5, 5]
initial x = 1
x' = a + b*u
observe x
"""


@pytest.mark.parametrize(("doses", "warned"), [((0.0, 0.3, 1.0), False), ((0.9, 0.95, 1.0), True)])
def test_they_are_those_of_least_squares(tmp_path: Path, doses: tuple[float, ...], warned: bool) -> None:
    (tmp_path / "line.gb").write_text(LINE)
    rng = np.random.default_rng(5)
    rows = [(k, t, u) for k, u in enumerate(doses) for t in (0.5, 1.0, 1.5, 2.0)]
    lines = [f"{k},{t},{1 + (0.5 - 0.7 * u) * t + 0.01 * rng.standard_normal()},{u}" for k, t, u in rows]
    (tmp_path / "line.csv").write_text("\n".join(["trajectory,t,x,u", *lines]) + "\n")
    run = gbspec.load(tmp_path / "line.gb").train(tmp_path / "line.csv", tmp_path / "run", effort="low").run
    design = np.array([[t, u * t] for _, t, u in rows])
    covariance = np.linalg.inv(design.T @ design)
    wanted = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    found = run.fit.correlations
    assert found["a"]["b"] == pytest.approx(wanted, abs=0.01) == found["b"]["a"]
    assert found["a"]["a"] == pytest.approx(1)
    assert any("`a` and `b` are strongly correlated" in warning for warning in run.fit.warnings) is warned


def table(*rows: tuple[float, ...]) -> dict[str, dict[str, float]]:
    names = "abcd"[: len(rows)]
    return {a: dict(zip(names, row, strict=True)) for a, row in zip(names, rows, strict=True)}


def test_three_constants_that_only_a_sum_of_is_known_are_named_though_no_pair_is() -> None:
    known = table((1, -0.49, -0.49, 0), (-0.49, 1, -0.49, 0), (-0.49, -0.49, 1, 0), (0, 0, 0, 1))
    (warning,) = moving_together(known)
    assert all(f"0.58 `{name}`" in warning for name in "abc") and "`d`" not in warning
    assert "the data determine the combination" in warning and "hardly" not in warning  # the sum is what is known


def test_a_pair_is_named_once_and_what_is_well_known_not_at_all() -> None:
    assert len(moving_together(table((1, 0.99, 0.1), (0.99, 1, 0.1), (0.1, 0.1, 1)))) == 1
    assert moving_together(table((1, 0.9), (0.9, 1))) == [] == moving_together({})


def test_nothing_is_said_of_constants_that_are_known_well_by_themselves() -> None:
    pair = table((1, 0.99), (0.99, 1))
    assert moving_together(pair, {"a", "b"}) == [] and len(moving_together(pair, {"a"})) == 1
    three = table((1, -0.49, -0.49), (-0.49, 1, -0.49), (-0.49, -0.49, 1))
    assert moving_together(three, {"a", "b", "c"}) == [] and len(moving_together(three, {"a", "b"})) == 1


def test_many_pairs_share_a_warning() -> None:
    pairs = [(1.0, 0.99, 0.98, 0.0), (0.99, 1.0, 0.97, 0.0), (0.98, 0.97, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)]
    (said,) = moving_together(table(*pairs))
    listed = "`a` and `b` (0.990); `a` and `c` (0.980); `b` and `c` (0.970). The data"
    assert said.startswith(f"strongly correlated constants: {listed}")
    assert len(moving_together(table(*pairs), {"a", "b"})) == 2
