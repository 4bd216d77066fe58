"""The run directory: files written whole, damage told as a diagnostic, members and their mean."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import Findings, UserError
from gbspec.runs import files, open_run
from gbspec.training import TrainOptions, train
from tests import quick
from tests.training.conftest import URP, model_of, urp_data


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "run"
    options = TrainOptions(members=2, workers=1, method="gradient-matching")
    with quick.warm_start(50):
        train(model_of(URP), urp_data(4, 2.0, 6), options, path)
    return path


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(made, tmp_path / "run"))


def test_a_run_that_another_process_trains_is_not_said_to_be_interrupted(run: Path) -> None:
    record = json.loads((run / files.FIT).read_text("utf-8"))
    record["finished"] = False
    (run / files.FIT).write_text(json.dumps(record), encoding="utf-8")

    def warning() -> tuple[str, str, str]:
        findings = Findings()
        opened = open_run(run, findings)
        (found,) = findings
        return found.code, found.message, found.help + " ".join(opened.fit.warnings)

    code, message, help = warning()
    assert (code, "was interrupted" in message, "`--resume` continues" in help) == ("GB865", True, True)
    holds = "import sys, filelock; a = filelock.FileLock(sys.argv[1]); a.acquire(); print('held', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", holds, str(run / files.LOCK)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdin is not None and other.stdout is not None
        assert other.stdout.readline() == "held\n"
        code, message, help = warning()
        other.communicate("\n")
    assert f"`{run}` is being trained by another process: member" in message
    assert (code, "`--resume` is not needed" in help, "interrupted" in help) == ("GB865", True, False)
    assert "was interrupted" in warning()[1]


def test_opens_with_model_members_and_mean(made: Path) -> None:
    run = open_run(made)
    assert run.model == model_of(URP)
    assert run.numbers == (0, 1) and run.best in run.numbers
    x = np.array([0.5, 1.5])

    def predict(module: object) -> np.ndarray:
        return module.rhs(0.0, x, [0.3]).numpy()  # type: ignore[attr-defined, no-any-return]

    each = [predict(run.member(k)) for k in (0, 1)]
    assert np.allclose(run.mean(predict), np.mean(each, axis=0), rtol=1e-12)
    assert np.allclose(run.standard_deviation(predict), np.std(each, axis=0), rtol=1e-9)
    assert run.step(1) == run.member(1).info["max_step"]
    assert len(run.history()) >= 4


@pytest.mark.parametrize(
    ("losses", "best"), [((0.2, 0.1), 1), ((0.1, 0.2), 0), ((0.1, 0.1), 0), ((None, 0.3), 1), ((0.3, None), 0)]
)
def test_the_best_member_has_the_smallest_loss(run: Path, losses: tuple[float | None, ...], best: int) -> None:
    """A member whose loss is not a number (`null`, as JSON has no infinity) is never preferred."""
    fit = json.loads((run / "fit.json").read_text())
    for entry, loss in zip(fit["members"], losses, strict=True):
        entry["loss"] = loss
    (run / "fit.json").write_text(json.dumps(fit))
    assert open_run(run).best == best


@pytest.mark.parametrize(("r2", "best"), [(((0.9, 0.9), (0.8, 0.9)), 0), (((0.9, 0.8), (0.9, 0.9)), 1)])
def test_members_with_other_weights_of_channels_are_compared_with_the_same(
    run: Path, r2: tuple[tuple[float, float], ...], best: int
) -> None:
    """The loss of the second member is smaller because one of its channels counts less."""
    fit = json.loads((run / "fit.json").read_text())
    for entry, loss, found, weight in zip(fit["members"], (0.09, 0.05), r2, (1.0, 0.01), strict=True):
        entry["loss"] = loss
        for name, value, each in zip(("x1", "x2"), found, (weight, 1.0), strict=True):
            entry["channels"][name] |= {"r2": value, "weight": each, "values": 100}
    (run / "fit.json").write_text(json.dumps(fit))
    assert open_run(run).best == best


def test_each_member_has_the_step_of_its_own_fit(run: Path) -> None:
    opened = open_run(run)
    opened.member(1).info["max_step"] = 0.025
    assert (opened.step(0), opened.step(1)) == (opened.member(0).info["max_step"], 0.025)


def test_the_written_module_stands_alone(made: Path) -> None:
    import importlib.util

    spec = importlib.util.spec_from_file_location("written_by_training", made / "model.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    loaded = module.SmallUrp.load(made, 1)
    assert np.array_equal(loaded.weights["constants"], open_run(made).member(1).weights["constants"])


def codes(caught: pytest.ExceptionInfo[UserError]) -> list[str]:
    return [d.code for d in caught.value.diagnostics]


def test_a_foreign_directory(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        open_run(tmp_path)
    assert codes(caught) == ["GB851"]


@pytest.mark.parametrize("damage", ["", "{", "[1, 2]", '{"name": "npm package"}'])
def test_a_damaged_fit(run: Path, damage: str) -> None:
    (run / "fit.json").write_text(damage)
    with pytest.raises(UserError) as caught:
        open_run(run)
    assert codes(caught) == ["GB852"]


def test_everything_missing_is_told_at_once(run: Path) -> None:
    (run / "model.gb").unlink()
    (run / "fit.json").write_text("{")
    with pytest.raises(UserError) as caught:
        open_run(run)
    assert codes(caught) == ["GB852", "GB852"]


def test_weights_cut_short_or_of_another_model(run: Path) -> None:
    weights = run / "members" / "0" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(UserError) as caught:
        open_run(run).member(0)
    assert codes(caught) == ["GB853"]
    (run / "model.gb").write_text(URP.replace("mlp(12, 12)", "mlp(9)"))
    with pytest.raises(UserError) as caught:
        open_run(run)
    assert codes(caught) == ["GB852", "GB853"]
    undigested(run)
    with pytest.raises(UserError) as caught:
        open_run(run).member(1)
    assert codes(caught) == ["GB853"]


def undigested(run: Path) -> None:
    """Takes the digests out of `fit.json`, which is then like those of version 0.1.0."""
    fit = json.loads((run / "fit.json").read_text())
    del fit["files"]
    for entry in fit["members"]:
        del entry["files"]
    (run / "fit.json").write_text(json.dumps(fit))


@pytest.mark.parametrize("name", ["weights", "checkpoint", "checkpoint.best"])
def test_a_flipped_bit_in_a_file_of_a_member_is_noticed(run: Path, name: str) -> None:
    path = run / "members" / "1" / f"{name}.safetensors"
    content = bytearray(path.read_bytes())
    content[-5] ^= 16
    path.write_bytes(content)
    with pytest.raises(UserError, match="members/1") as caught:
        open_run(run)
    assert codes(caught) == ["GB853" if name == "weights" else "GB852"]
    undigested(run)
    if name == "weights":  # the file has a digest of its own too
        with pytest.raises(UserError, match="not what was written"):
            open_run(run).member(1)
    else:
        with pytest.raises(ValueError, match="not what was written"):
            files.read_tensors(path)


def test_members_that_are_not_there(run: Path) -> None:
    with pytest.raises(UserError) as caught:
        open_run(run).member(7)
    assert codes(caught) == ["GB854"]
    shutil.rmtree(run / "members")
    with pytest.raises(UserError) as caught:
        open_run(run)
    assert codes(caught) == ["GB853", "GB853"]


def test_files_are_replaced_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "fit.json"
    files.write_json(path, {"a": 1.0})

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        files.write_json(path, {"a": 2.0})
    assert json.loads(path.read_text()) == {"a": 1.0}
    assert [p.name for p in tmp_path.iterdir()] == ["fit.json"]


def test_json_keeps_order_full_precision_and_no_nan(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    files.write_json(path, {"z": np.float64(0.1) + 0.2, "a": [np.nan, np.inf, np.int64(3)], "m": np.arange(2.0)})
    text = path.read_text()
    assert json.loads(text) == {"z": 0.30000000000000004, "a": [None, None, 3], "m": [0.0, 1.0]}
    assert list(json.loads(text)) == ["z", "a", "m"]


def test_checkpoints_come_back_bit_by_bit(tmp_path: Path) -> None:
    path = tmp_path / "c.safetensors"
    arrays = {"a": np.random.default_rng(0).standard_normal((3, 2)), "scalar": np.array(0.1), "none": np.zeros((0, 4))}
    files.write_tensors(path, arrays, {"stage": 3, "names": ["ä", "b"]})
    back, remarks = files.read_tensors(path)
    assert all(np.array_equal(back[k], v) and back[k].shape == v.shape for k, v in arrays.items())
    assert remarks == {"stage": 3, "names": ["ä", "b"]}
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(ValueError, match="damaged"):
        files.read_tensors(path)


def test_a_checkpoint_whose_remarks_have_another_form_is_damaged(run: Path) -> None:
    files.write_tensors(run / "members" / "0" / "checkpoint.safetensors", {}, {"stage": "first"})
    options = TrainOptions(members=2, workers=1, method="gradient-matching", resume=True)
    with pytest.raises(UserError) as caught:
        train(model_of(URP), urp_data(4, 2.0, 6), options, run)
    (found,) = caught.value.diagnostics
    assert found.code == "GB852" and '`stage` is "first"; expected a whole number' in found.message


def test_a_run_whose_module_was_imported_is_resumed(run: Path) -> None:
    (run / "__pycache__").mkdir(exist_ok=True)
    options = TrainOptions(members=2, workers=1, method="gradient-matching", resume=True)
    assert train(model_of(URP), urp_data(4, 2.0, 6), options, run).numbers == (0, 1)


def test_a_directory_with_other_files_is_refused(run: Path) -> None:
    (run / "thesis.tex").touch()
    options = TrainOptions(members=2, workers=1, method="gradient-matching", resume=True)
    with pytest.raises(UserError, match=r"thesis\.tex"):
        train(model_of(URP), urp_data(4, 2.0, 6), options, run)
