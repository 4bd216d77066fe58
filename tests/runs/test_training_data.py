"""Where a run finds the data that it was trained on, and what is said if they are gone or were changed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import gbspec
from gbspec.data import Trajectories, content_digest, from_arrays, same_content, to_arrays
from gbspec.diagnostics import Findings, UserError
from gbspec.operations.tables import trained_on, training_data
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from tests import tampering
from tests.training.conftest import EVERYTHING, everything_data, model_of, trajectory


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("original")
    tampering.make(place)
    return place


@pytest.fixture
def place(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "place"))


def test_the_table_is_found_from_another_folder(place: Path, tmp_path: Path, original: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    status, out, said = tampering.called(("validate", str(original / "run")), tmp_path / "elsewhere")
    assert status == 0 and str(original / "data.csv") in said and "nrmse" in out.lower()
    found = training_data(open_run(place / "run"), Findings())  # moved together: beside the run as before
    assert found is not None and found.measurements == 14
    fit = open_run(place / "run").fit
    assert fit.data.relative == os.path.join("..", "data.csv") and fit.data.absolute == str(original / "data.csv")


@pytest.mark.parametrize("command", [("validate", "run"), ("report", "run", "-o", "r.html")])
def test_a_table_that_is_gone_or_was_changed_is_told(place: Path, original: Path, command: tuple[str, ...]) -> None:
    # as on another machine, where the absolute path leads nowhere
    text = (place / "run" / "fit.json").read_text().replace(str(original), "/nowhere")
    (place / "run" / "fit.json").write_text(text)
    table = place / "data.csv"
    table.write_text(table.read_text().replace("0.125", "0.126"))
    status, _, said = tampering.called(command, place)
    assert status == 1 and "GB859" in said and "was changed after the training" in said
    table.unlink()
    status, _, said = tampering.called(command, place)
    assert status == 1 and "GB859" in said and "no longer at that path" in said
    assert not (place / "r.html").exists()
    status, _, said = tampering.called(("plot", "run", "history", "-o", "f.svg"), place)
    assert status == 0 and "warning[GB859]" in said, "a figure that needs no data is drawn"


def frame_of(place: Path) -> pl.DataFrame:
    return pl.read_csv(place / "data.csv")


def rounded(frame: pl.DataFrame) -> pl.DataFrame:
    """As another program may read it: one unit in the last place apart."""
    return frame.with_columns(pl.Series("x", np.nextafter(frame["x"].to_numpy(), np.inf)))


def test_a_data_frame_with_the_content_of_the_table_is_that_of_the_training(place: Path) -> None:
    run, frame = gbspec.open_run(place / "run"), frame_of(place)
    starts = run.learned_starts()
    assert run.learned_starts(frame).equals(starts)
    assert run.learned_starts(rounded(frame)).equals(starts)
    assert run.evaluate(rounded(frame)).nllh == run.evaluate().nllh
    copied = place / "copied.csv"
    frame.write_csv(copied, line_terminator="\r\n")
    assert run.learned_starts(copied).equals(starts)
    for other in (frame.with_columns(pl.col("x") * 1.001), frame[:-1]):
        with pytest.raises(UserError, match="not what the run was trained on"):
            run.learned_starts(other)


def test_the_command_line_takes_a_rounded_copy_for_the_training_data_as_python_does(place: Path) -> None:
    rounded(frame_of(place)).write_csv(place / "copied.csv")
    run = gbspec.open_run(place / "run")
    for command in (("evaluate", "run"), ("validate", "run"), ("predict", "run", "-o", "p.csv")):
        said = [tampering.called((*command[:2], table, *command[2:]), place)[1] for table in ("data.csv", "copied.csv")]
        assert said[0] == said[1] != "", command
    assert str(run.predict(place / "copied.csv")) == str(run.predict(place / "data.csv"))
    assert str(run.validate(place / "copied.csv")) == str(run.validate(place / "data.csv"))


def test_rounded_data_have_the_labels_that_were_given(place: Path) -> None:
    frame = frame_of(place)
    names = {label: f"0{label}.0" for label in frame["trajectory"].cast(pl.String).unique()}
    named = rounded(frame).with_columns(pl.col("trajectory").cast(pl.String).replace(names))
    run = gbspec.open_run(place / "run")
    assert {item.label for item in run.predict(named).items} == set(names.values())
    assert run.evaluate(named).nllh == run.evaluate().nllh


def test_data_that_may_be_those_of_the_training_are_told_where_the_table_is_gone(place: Path, original: Path) -> None:
    rounded(frame_of(place)).write_csv(place / "copied.csv")
    text = (place / "run" / "fit.json").read_text().replace(str(original), "/nowhere")
    (place / "run" / "fit.json").write_text(text)
    (place / "data.csv").unlink()
    run, table = gbspec.open_run(place / "run"), place / "copied.csv"
    told = "no longer at that path; the given data, as many as these"
    for found in (run.evaluate(table), run.validate(table), run.predict(table)):
        assert told in str(found.notes()) + str(getattr(found, "warnings", ()))
    for command in (("evaluate", "run", "copied.csv"), ("predict", "run", "copied.csv", "-o", "p.csv")):
        status, _, said = tampering.called(command, place)
        assert status == 0 and "warning[GB859]" in said and told in " ".join(said.split())


@pytest.mark.parametrize(("one", "other", "same"), [("nan", "nan", True), ("1_0", "10", False), ("01", "1", True)])
def test_labels_are_the_same_as_texts_or_as_numbers(one: str, other: str, same: bool) -> None:
    times = np.linspace(0, 1, 4)
    made = [Trajectories((trajectory(label, 0.0, times, times[:, None], []),), ("x",)) for label in (one, other)]
    assert same_content(*made) is same


def test_a_data_frame_is_recognised_where_the_table_is_gone(place: Path, original: Path) -> None:
    frame = frame_of(place)
    text = (place / "run" / "fit.json").read_text().replace(str(original), "/nowhere")
    (place / "run" / "fit.json").write_text(text)
    (place / "data.csv").unlink()
    run = gbspec.open_run(place / "run")
    assert len(run.learned_starts(frame)) == frame["trajectory"].n_unique()
    with pytest.raises(UserError, match="its table is gone"):
        run.learned_starts(rounded(frame))


def test_data_in_no_table_are_kept_with_the_run(tmp_path: Path) -> None:
    times = np.linspace(0, 1, 4)
    item = trajectory("a", 0.0, times, np.exp(-times)[:, None], [])
    data = Trajectories((item,), ("x",))
    options = TrainOptions(method="lm", epochs=1, warm_start=False, workers=1, threads=1)
    model = model_of("model decay\nstate x\nlearn k = 1 in [0, 5]\nx' = -k*x\nobserve x\n")
    run = train(model, data, options, tmp_path / "run")
    found = trained_on(open_run(run.path), None, Findings())
    assert found.items[0].label == "a" and np.array_equal(found.items[0].values, item.values)
    other = Trajectories((trajectory("a", 0.0, times, np.exp(-2 * times)[:, None], []),), ("x",))
    with pytest.raises(UserError, match="other data"):
        train(model, other, TrainOptions(**{**vars(options), "resume": True}), tmp_path / "run")


def test_everything_that_data_can_have_is_kept_exactly() -> None:
    data, model = everything_data(), model_of(EVERYTHING)
    arrays, remarks = to_arrays(data)
    found = from_arrays(arrays, remarks["labels"], remarks["channels"], len(model.inputs), 0)  # type: ignore[arg-type]
    assert content_digest(found) == content_digest(data) == found.sha256
    assert content_digest(data.subset([0])) != content_digest(data)
