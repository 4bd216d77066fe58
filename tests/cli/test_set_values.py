"""--set on the commands that read a run: other values replace learned ones, in the run and in its truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build, needed

pytestmark = pytest.mark.usefixtures("quick_fits", "few_points")

Run = Callable[..., Any]

MODEL = """\
model decay "Known decay, learned rates"
state x in [0, 2] = 1
condition u in [0, 1]
learn k = 0.5 in [0, 3]
learn own = 0.1 in [0, 1] per trajectory
unknown extra(x) by mlp(4)
x' = -k*x + own*u - extra(x)
observe x
truth k = 0.8
truth extra(x) = 0.1*x^2
"""


def call(*arguments: object) -> Any:
    texts = [str(argument) for argument in arguments]
    return CliRunner().invoke(build(needed(texts)), texts)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("set")
    (folder / "m.gb").write_text(MODEL)
    assert call("simulate", folder / "m.gb", "-o", folder / "d.csv", "--trajectories", 2, "--span", 3).exit_code == 0
    made = call("train", folder / "m.gb", folder / "d.csv", "-o", folder / "run", "--method", "lm", "--epochs", 2,
                "--quiet")  # fmt: skip
    assert made.exit_code == 0, made.stderr
    yield folder


def document(*arguments: object) -> Any:
    result = call(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def test_validate_uses_the_value_that_was_set(place: Path) -> None:
    found = document("validate", place / "run", "--set", "k=2.5")
    assert found["channels"]["x"]["nrmse"] > 0.3
    # The truth of the comparison has the value too.
    assert found["truth"]["constants"]["k"] == pytest.approx(0.0, abs=1e-12)


def test_a_per_trajectory_constant_is_set_for_all_trajectories(place: Path) -> None:
    import gbspec
    from gbspec.operations import models

    run = models.open_run(place / "run", {"own": 0.7, "k": 1.25})
    member = run.member()
    assert member.weights["per_trajectory.own"].tolist() == [0.7] * 2
    assert dict(zip(member.constants, member.weights["constants"], strict=True))["k"] == 1.25
    assert gbspec.open_run(place / "run").member().weights["per_trajectory.own"].tolist() != [0.7] * 2


def test_predictions_use_the_value(place: Path, here: Path) -> None:
    import polars as pl

    for name, more in (("a.csv", ()), ("b.csv", ("--set", "k=2.5"))):
        assert call("predict", place / "run", place / "d.csv", "-o", name, "--quiet", *more).exit_code == 0
    a, b = (pl.read_csv(name) for name in ("a.csv", "b.csv"))
    assert b["x"][-1] < 0.7 * a["x"][-1]


def test_figures_use_the_value(place: Path, here: Path) -> None:
    for name, more in (("a.svg", ()), ("b.svg", ("--set", "k=2.5"))):
        assert call("plot", place / "run", "fit", "-o", name, *more).exit_code == 0
    assert Path("a.svg").read_text() != Path("b.svg").read_text()


@pytest.mark.parametrize("command", ["validate", "plot", "report", "predict", "eigen", "bifurcate"])
def test_a_name_that_cannot_be_set(place: Path, here: Path, command: str) -> None:
    rest = {
        "plot": ("fit", "-o", "f.svg"),
        "predict": (str(place / "d.csv"), "-o", "p.csv"),
        "bifurcate": ("--over", "u", "--range", "0", "1"),
    }
    result = call(command, place / "run", *rest.get(command, ()), "--set", "kk=1")
    assert result.exit_code == 1
    assert "GB804" in result.stderr
    assert "did you mean `k`?" in result.stderr
