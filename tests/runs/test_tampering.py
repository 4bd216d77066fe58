"""Commands on run directories that were changed: a few of the campaign `python -m tests.tampering`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from gbspec.diagnostics import UserError
from gbspec.runs import files, open_run
from tests import tampering


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("original")
    tampering.make(place)
    return place


@pytest.mark.parametrize("number", range(12))
def test_no_change_makes_a_defect(original: Path, number: int) -> None:
    ((arguments, status, said),) = tampering.one(original, number)
    assert status in (0, 1, 2, 3), (arguments, said)


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
    shutil.copytree(original, tmp_path / "place")
    return tmp_path / "place" / "run"


def test_folders_that_only_look_like_members_are_none(run: Path) -> None:
    for name in ("²", "٣", "007", "-1"):
        shutil.copytree(run / "members" / "0", run / "members" / name)
    assert open_run(run).numbers == (0, 1)


@pytest.mark.parametrize("content", ["member,stage\n0", "", "member,stage,iteration,seconds,loss,k,b\n0,lm,1,0.5"])
def test_a_history_cut_short_is_damaged(run: Path, content: str) -> None:
    (run / files.HISTORY).write_text(content)
    with pytest.raises(UserError, match=r"GB852.*history\.csv"):
        open_run(run)
    tampering.resealed(run)
    with pytest.raises(UserError, match=r"GB852.*history\.csv"):
        open_run(run).history()


def test_weights_without_initial_states_are_damaged(run: Path) -> None:
    member = open_run(run).member(0)
    weights = {name: value for name, value in member.weights.items() if name != "initial"}
    info = {name: value for name, value in member.info.items() if name != "sha256"}
    type(member)(weights, info).save(files.member_directory(run, 0) / files.WEIGHTS)
    tampering.resealed(run)
    with pytest.raises(UserError, match=r"GB853.*member 0"):
        open_run(run).member(0)


def test_a_checkpoint_with_deviations_of_another_shape_is_damaged(run: Path) -> None:
    path = run / "members" / "1" / "checkpoint.safetensors"
    arrays, remarks = files.read_tensors(path)
    files.write_tensors(path, {**arrays, "deviations": arrays["deviations"][:, None]}, remarks)
    status, _, said = tampering.called(tampering.COMMANDS[-1], run.parent)
    assert status == 1 and "another shape" in said


@pytest.mark.parametrize("name", ["theta", "best", "entry", "deviations"])
def test_a_checkpoint_without_a_vector_is_damaged(run: Path, name: str) -> None:
    path = run / "members" / "1" / "checkpoint.safetensors"
    arrays, remarks = files.read_tensors(path)
    del arrays[name]
    files.write_tensors(path, arrays, remarks)
    status, _, said = tampering.called(tampering.COMMANDS[-1], run.parent)
    assert status == 1 and f"it has no '{name}'" in said


def test_a_record_that_lists_other_members_than_there_are(run: Path) -> None:
    fit = json.loads((run / "fit.json").read_text())
    fit["members"][1]["member"] = 99
    (run / "fit.json").write_text(json.dumps(fit))
    with pytest.raises(UserError, match=r"members/99"):
        open_run(run)
