"""Intervals of folds and Hopf points from one fit: how they move with weights and constants, to first order."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.continuation import SpecialPoint
from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.analysis.bifurcation.members import with_intervals
from gbspec.analysis.bifurcation.uncertainty import point_slopes
from gbspec.analysis.systems import Family
from gbspec.analysis.systems.system import system_of
from gbspec.backends import Evaluator
from gbspec.backends.module import load_module
from gbspec.cli.app import build
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.runs import NORMAL_90, Certainties, ConstantRecord, Covariance
from tests.analysis.conftest import model_of, nearly_true

LOW, HIGH = 0.15, 0.3
QUICK = BifurcationOptions(values=3, starts=8, cycles=False)

CUSP = """\
model cusp "The cusp normal form with a learned slope"
state x in [-2, 2] = 0
condition h in [-1, 1]
learn r = 1.2 in [0.1, 3]
x' = h + r*x - x^3
observe x
"""


def diagram_of(member: Any, values: dict[str, float] | None = None) -> tuple[Diagram, Family]:
    system = system_of(Evaluator(member), model_of("urp_gb2"))
    system = system.with_values(values or {})
    return bifurcate(system, "Da", LOW, HIGH, QUICK), Family(system, "Da")


@pytest.mark.parametrize(
    ("name", "size"), [("network.phi.2.weight", 1e-5), ("network.phi.1.weight", 1e-7), ("constants", 1e-5)]
)
def test_a_hopf_point_moves_with_weights_and_constants_as_it_is_said_to(name: str, size: float) -> None:
    member = nearly_true()
    made, family = diagram_of(member)
    (point,) = made.of_kind("hopf")
    slopes = point_slopes(point, family, HIGH - LOW, member)
    assert {key for key in slopes if key != "constants"} == {
        key for key in member.shapes() if key.endswith((".weight", ".bias"))
    }
    direction = np.random.default_rng(1).standard_normal(member.weights[name].shape)
    moved = []
    for sign in (1, -1):
        weights = {**member.weights, name: member.weights[name] + sign * size * direction}
        (other,) = diagram_of(type(member)(weights, member.info))[0].of_kind("hopf")
        moved.append(other.value)
    expected = (moved[0] - moved[1]) / (2 * size)
    assert float(np.sum(slopes[name] * direction)) == pytest.approx(expected, rel=2e-4)


def test_a_fold_moves_with_a_constant_as_its_formula_says(tmp_path: Path) -> None:
    (tmp_path / "cusp.gb").write_text(CUSP)
    model = load_model(tmp_path / "cusp.gb", Findings())
    member = load_module(model).random(0)
    system = system_of(Evaluator(member), model)
    made = bifurcate(system, "h", -1.0, 1.0, BifurcationOptions(cycles=False))
    folds = made.of_kind("fold")
    assert len(folds) == 2
    for point, sign in zip(folds, (-1, 1), strict=True):
        assert point.value == pytest.approx(sign * 2 * (1.2 / 3) ** 1.5)
        slopes = point_slopes(point, Family(system, "h"), 2.0, member)
        assert slopes["constants"] == pytest.approx([sign * np.sqrt(1.2 / 3)])


def test_the_interval_is_in_text_json_and_figure(
    write_run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    member = nearly_true()
    run = write_run(model_of("urp_gb2"), member)
    names = tuple(key for key in member.shapes() if key.endswith((".weight", ".bias")))
    size = sum(int(np.prod(member.shapes()[key])) for key in names)
    known = Covariance(
        names, ("B", "beta"), 1e-12, np.zeros((0, size)), np.zeros(0), np.zeros((2, size)), np.diag([0.02, 1e-6]) ** 2
    )
    Certainties(known).write(run.path / "members" / "0")

    def asked(*more: object) -> Any:
        texts = ["bifurcate", str(run.path), "--over", "Da", "--range", str(LOW), str(HIGH), *map(str, more)]
        result = CliRunner().invoke(build(("bifurcate",)), texts)
        assert result.exit_code == 0, result.stderr
        return result

    (point,) = json.loads(asked("--json").stdout)["special"]
    slope = point_slopes(diagram_of(member)[0].special[0], diagram_of(member)[1], HIGH - LOW, member)["constants"]
    expected = abs(slope[member.constants.index("B")]) * 0.02
    assert point["sd"] == pytest.approx(expected, rel=1e-2)
    ends = [point["value"] - NORMAL_90 * point["sd"], point["value"] + NORMAL_90 * point["sd"]]
    assert point["interval"] == pytest.approx(ends)
    text = asked("-o", tmp_path / "diagram.svg").stdout
    assert f"[{ends[0]:.6g}, {ends[1]:.6g}]" in text
    # What the user has set is not uncertain.
    assert json.loads(asked("--json", "--set", "B=11").stdout)["special"][0]["sd"] < 0.01 * expected
    # A run that knows no interval of any constant knows none of a point.
    unknown = {name: ConstantRecord(1.0, None, None, 1.0, (1.0,)) for name in ("B", "beta")}
    run.amended(replace(run.fit, constants=unknown))
    (point,) = json.loads(asked("--json").stdout)["special"]
    assert (point["sd"], point["interval"]) == (None, None)


def test_members_add_their_differences() -> None:
    def diagram(value: float, sd: float | None) -> Diagram:
        point = SpecialPoint("fold", value, np.zeros(1), sd=sd, interval=None)
        return Diagram("m", "p", 0, 1, ("x",), (), (point,), ())

    (point,) = with_intervals([diagram(0.5, 0.03), diagram(0.52, 0.03)]).special
    sd = np.sqrt(0.03**2 + 0.02**2 / 2)
    assert point.sd == pytest.approx(sd)
    assert point.interval == pytest.approx((0.51 - NORMAL_90 * sd, 0.51 + NORMAL_90 * sd))
    (point,) = with_intervals([diagram(0.5, None), diagram(0.52, 0.03)]).special
    assert (point.interval, point.sd) == ((0.5, 0.52), None)
    lonely = replace(diagram(0.5, 0.03), special=())
    assert with_intervals([diagram(0.5, 0.03), lonely]).special[0].interval is None
