"""`gbspec export`, and the same from Python."""

from __future__ import annotations

import json
import shutil
import typing
from pathlib import Path

import pytest
from typer.testing import CliRunner

import gbspec
from gbspec.cli.app import build
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings, UserError
from gbspec.exports import ExportOptions
from gbspec.exports.c.printer import WORDS
from gbspec.frontend import load_model
from gbspec.ir import METHODS
from gbspec.operations import exporting, models

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def call(*arguments: str | Path) -> tuple[int, str, str]:
    done = CliRunner().invoke(build(["export", "models"]), ["export", *map(str, arguments)])
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
def test_the_result_as_json(tmp_path: Path) -> None:
    status, said, _ = call("methanol", "-o", tmp_path / "x.fmu", "--as", "fmu3", "--json")
    found = json.loads(said)
    assert status == 0 and found["form"] == "fmu3" and found["size"] < 200_000
    assert len(found["fingerprint"]) == 64 and max(found["checked"].values()) < 1e-12
    assert "the directional derivatives of the unit" in found["checked"]


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
def test_a_difference_has_status_3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(WORDS, "exp", "expm1")
    status, _, said = call("urp_gb2", "-o", tmp_path / "x", "--as", "c")
    assert status == 3 and "differs from the generated module: the right-hand side by" in said
    assert not (tmp_path / "x").exists()
    assert call("urp_gb2", "-o", tmp_path / "x", "--as", "c", "--no-verify")[0] == 0


def test_a_folder_is_said_to_be_one(tmp_path: Path) -> None:
    status, _, said = call("urp_gb2", "-o", tmp_path / "reactor.c", "--as", "c", "--no-verify")
    count = sum(one.is_file() and not one.name.startswith(".") for one in (tmp_path / "reactor.c").rglob("*"))
    assert status == 0 and f"wrote the folder {tmp_path / 'reactor.c'} ({count} files): " in said
    _, _, said = call("urp_gb2", "-o", tmp_path / "reactor.zip", "--as", "c", "--no-verify")
    assert f"wrote {tmp_path / 'reactor.zip'}: " in said


def test_wrong_forms_parts_and_models(tmp_path: Path) -> None:
    assert call("methanol", "-o", tmp_path / "x", "--as", "fmu4")[0] == 2
    status, _, said = call("methanol", "-o", tmp_path / "x", "--as", "c", "--part", "rhs")
    assert status == 2 and "GB881" in said
    status, _, said = call("nothing_there", "-o", tmp_path / "x", "--as", "c")
    assert status == 1 and "GB001" in said
    status, _, said = call("methanol", "-o", tmp_path / "none" / "x.zip", "--as", "c")
    assert status == 1 and "GB805" in said


def test_an_unknown_without_a_truth_needs_a_run(tmp_path: Path) -> None:
    model = tmp_path / "m.gb"
    model.write_text("model m\nstate x in [0, 1]\nunknown f(x)\nx' = f(x)\nobserve x\n", encoding="utf-8")
    status, _, said = call(model, "-o", tmp_path / "x", "--as", "c")
    assert status == 1 and "GB803" in said


def test_from_python(tmp_path: Path) -> None:
    model = gbspec.load("methanol")
    made = model.export(tmp_path / "library.zip", "c", verify=False, values={"k1": 2.0} if "k1" in str(model) else None)
    assert made.path.endswith("library.zip") and (tmp_path / "library.zip").is_file()
    with pytest.raises(ValueError, match="no form `dll`"):
        model.export(tmp_path / "x", "dll")  # type: ignore[arg-type]


def test_the_forms_for_type_checkers_are_those_that_there_are() -> None:
    assert set(typing.get_args(exporting.ExportForm)) == set(exporting.forms())


@pytest.mark.usefixtures("quick_fit")
@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
def test_a_run_with_its_learned_values(tmp_path: Path) -> None:
    """A fit of one function: its weights, the ranges that it learned from and the solver's step are in the export."""
    text = "model decay\ntime t\nstate x in [0, 3]\nlearn k = 0.5 in [0, 5]\nunknown f(x) by mlp(4)\nx' = -f(x) - k*x\n"
    path = tmp_path / "decay.gb"
    path.write_text(text + "observe x\ntruth k = 0.3\ntruth f(x) = 0.2*x^2\n", encoding="utf-8")
    model = gbspec.load(path)
    data = model.simulate(trajectories=4, span=2.0, dt=0.25)
    run = model.train(data, tmp_path / "run", effort="low", max_step=0.125)
    made = run.export(tmp_path / "library", "c")
    assert max(made.checked.values()) < 1e-12
    source = (tmp_path / "library" / "decay.c").read_text(encoding="utf-8")
    assert f"p->k = {run.constants['k']!r};" in source
    assert "a[0] >= " in source and run.export(tmp_path / "x.fmu", "fmu").checked


@pytest.mark.parametrize("form", ["c", "fmu2", "fmu3", "onnx"])
def test_steps_of_a_solver_for_stiff_models_are_refused_with_the_reason(form: str, tmp_path: Path) -> None:
    """Nothing is written."""
    if form == "onnx":
        pytest.importorskip("onnx", reason="the package onnx is not installed")
    model = load_model(shipped_models()["robertson"], Findings())
    source = models.reference(model, None, METHODS["ros34pw2"])
    with pytest.raises(UserError) as caught:
        exporting.export(source, tmp_path / "x", form, ExportOptions(), Findings())
    (diagnostic,) = caught.value.diagnostics
    assert diagnostic.code == "GB808" and "`ros34pw2`, for stiff models, needs the Jacobian" in diagnostic.message
    assert "--solver dopri5" in diagnostic.message and not list(tmp_path.iterdir())
