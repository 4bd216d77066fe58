"""Points in files: how they are written, and that runs and other texts of a model do without them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.simulation.simulate import simulate
from gbspec.backends import Evaluator, load_module
from gbspec.data import SimulateOptions
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir import Model
from gbspec.passes.truth import with_truth
from gbspec.runs import open_run
from gbspec.syntax.formatter import format_text
from gbspec.training import TrainOptions, train

CELL = """model cell
state soc
table ocv(soc) : V from "points/ocv.csv" pchip # measured slowly
soc' = -0.1
observe voltage : V = ocv(soc)
"""


def cell(folder: Path, points: str, text: str = CELL) -> Model:
    (folder / "points").mkdir(exist_ok=True)
    (folder / "points" / "ocv.csv").write_bytes(points.encode())
    (folder / "cell.gb").write_text(text)
    findings = Findings()
    return load_model(folder / "cell.gb", findings)


PLAIN = "soc,ocv\n0,3.2\n0.5,3.7\n1,4.2\n"


@pytest.mark.parametrize(
    "points",
    [
        PLAIN,
        "\ufeff# a comment\r\nocv;soc\r\n4.2;1\r\n\r\n3.2;0\r\n3.7;0.5\r\n",
        "0\t3.2\n5e-1\t3.7\n1\t+4.2\n",
        '"soc", "ocv", note\n0, 3.2, x\n0.5, 3.7,\n1, 4.2, y\n',
    ],
)
def test_a_file_may_be_written_in_several_ways(points: str, tmp_path: Path) -> None:
    (table,) = cell(tmp_path, points).tables
    assert table.curve.knots == ((0.0, 0.5, 1.0),)
    assert table.curve.values == (3.2, 3.7, 4.2)


def test_the_text_of_a_model_has_the_points(tmp_path: Path) -> None:
    model = cell(tmp_path, PLAIN)
    assert "= (0.0, 3.2), (0.5, 3.7), (1.0, 4.2) pchip # measured slowly" in model.text
    again = load_model("elsewhere.gb", Findings(), lambda path: Source(str(path), model.text))
    assert again.tables == model.tables
    assert again.text == model.text
    assert format_text(Source("cell.gb", model.text))
    other = cell(tmp_path, PLAIN.replace("3.7", "3.8"))
    assert other.text != model.text and other.tables != model.tables


def test_many_points_and_an_extended_file(tmp_path: Path) -> None:
    places = np.linspace(0, 1, 400)
    cell(tmp_path, "".join(f"{x!r},{3 + x * x!r}\n" for x in places.tolist()))
    (tmp_path / "cold.gb").write_text('model cold extends "cell.gb"\nsoc\' = -0.2\n')
    model = load_model(tmp_path / "cold.gb", Findings())
    again = load_model("elsewhere.gb", Findings(), lambda path: Source(str(path), model.text))
    assert again.tables == model.tables and again.name == "cold"


@pytest.mark.usefixtures("quick_fit")
def test_the_bundled_cell_is_learned_and_its_run_does_without_the_file(tmp_path: Path) -> None:
    model = load_model("cell", Findings())
    known = with_truth(model)
    options = SimulateOptions(trajectories=4, span=2400.0, dt=120.0, keep_start=True, noise=0.002, seed=3)
    data = simulate(Evaluator(load_module(known)()), model, options)
    run = train(model, data, TrainOptions(), tmp_path / "run")
    (member,) = run.fit.members
    rmse = member.rmse["voltage"]
    assert rmse is not None and 1 - rmse**2 / np.nanvar([item.values for item in data.items]) > 0.999
    soc = np.linspace(0.2, 0.8, 7)
    learned = Evaluator(run.member()).functions_many("R", soc[:, None])
    assert learned == pytest.approx(0.1562 * np.exp(-24.37 * soc) + 0.07446, rel=0.1)
    again = open_run(tmp_path / "run")
    assert again.model.tables == model.tables
    assert "cell_ocv.csv" not in (tmp_path / "run" / "model.gb").read_text()
