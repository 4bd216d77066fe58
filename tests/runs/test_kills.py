"""Training that is killed at any write can be continued, and ends with the numbers of a training that was not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gbspec.cli.commands.train import target
from gbspec.diagnostics import Findings, UserError
from gbspec.files import is_aside, write_bytes
from gbspec.runs import Run, files, locked, open_run
from gbspec.training import TrainOptions, train
from tests.training.conftest import Recorder, model_of, trajectory

MODEL = "model decay\nstate x\nlearn k = 1 in [0, 5]\nx' = -k*x\nobserve x\n"
OPTIONS: dict[str, Any] = {"method": "lm", "epochs": 2, "warm_start": False, "workers": 1, "threads": 1}
OPTIONS |= {"solver": "rk4"}  # `auto` compares solvers first, which writes nothing


class KilledError(BaseException):
    """The process ends here: nothing after it is done."""


@contextmanager
def killed_at(number: int) -> Iterator[list[str]]:
    """Ends at the nth step of the writes (a file beside, its sync, its renaming), without cleaning up, as a kill."""
    steps: list[str] = []
    dead = False

    def step(name: str, do: Any) -> Any:
        def stopped(*given: Any, **named: Any) -> Any:
            nonlocal dead
            if not dead and name != "unlink":
                steps.append(name)
                dead = len(steps) == number
            if dead:
                raise KilledError
            return do(*given, **named)

        return stopped

    with pytest.MonkeyPatch.context() as patch:
        for where, name in (("tempfile", "mkstemp"), ("os", "fsync"), ("os", "replace")):
            patch.setattr(f"{where}.{name}", step(name, getattr(sys.modules[where], name)))
        patch.setattr(Path, "unlink", step("unlink", Path.unlink))
        yield steps


def data() -> Any:
    from gbspec.data.trajectories import Trajectories

    times = np.linspace(0.0, 1.0, 5)
    item = trajectory("a", 0.0, times, np.exp(-2 * times)[:, None], [])
    return Trajectories((item,), ("x",), "made.csv", "0" * 64)


def fitted(path: Path, **more: Any) -> Run:
    return train(model_of(MODEL), data(), TrainOptions(**OPTIONS, **more), path)


@pytest.fixture(scope="module", autouse=True)
def whole(tmp_path_factory: pytest.TempPathFactory, quick_fits: None) -> Path:
    """A run that was not killed, made before all tests: the compiled kernel is then no write of theirs."""
    path = tmp_path_factory.mktemp("whole") / "run"
    fitted(path, members=2)
    return path


def contents(run: Path) -> dict[str, object]:
    """What a run says and its numbers, without times."""
    opened = open_run(run)
    fit = opened.fit.to_json()
    for entry in fit["members"]:
        entry.pop("seconds"), entry.pop("files")
        for stage in entry["stages"]:
            stage.pop("seconds")
    fit.pop("files")
    rows = [{name: cell for name, cell in row.items() if name != "seconds"} for row in opened.history()]
    weights = [{name: value.tobytes() for name, value in member.weights.items()} for member in opened.members]
    names = sorted(str(p.relative_to(run)) for p in run.rglob("*") if p.is_file())
    return {"fit": fit, "history": rows, "weights": weights, "files": names}


def count_of_steps(tmp_path: Path) -> int:
    with killed_at(0) as steps:
        fitted(tmp_path / "counted", members=2)
    return len(steps)


def test_a_kill_at_any_write_leaves_a_run_that_goes_on(whole: Path, tmp_path: Path) -> None:
    """Some steps of the writes; the campaign (`python -m benchmarks.studies.kills`) takes all, and random moments."""
    expected = contents(whole)
    last = count_of_steps(tmp_path)
    assert last > 60
    for number in [3, *range(9, last, 24), last]:
        path = tmp_path / str(number)
        with killed_at(number), pytest.raises(KilledError):
            fitted(path, members=2)
        usable(path)
        resume = (path / files.FIT).is_file()
        target(str(path), resume=resume)
        fitted(path, members=2, resume=True)
        assert contents(path) == expected, f"killed at {number}"


def usable(path: Path) -> None:
    """A run in which a member has weights can be opened, and says that it is not finished."""
    if any(path.glob("members/*/weights.safetensors")):
        findings = Findings()
        run = open_run(path, findings)
        assert run.fit.finished or [d.code for d in findings] == ["GB865"]
        assert set(run.fit.constants) == {"k"} and len(run.fit.members) == len(run.numbers)
        assert run.best in run.numbers


def test_a_kill_while_a_run_is_resumed_leaves_one_that_goes_on(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(model_of(MODEL), data(), TrainOptions(**OPTIONS, members=2), path, Recorder(interrupt_after=2))
    assert open_run(path).fit.finished is False
    for number in (1, 8, 15):
        with killed_at(number), pytest.raises(KilledError):
            fitted(path, members=2, resume=True)
        usable(path)
    fitted(path, members=2, resume=True)
    assert contents(path) == contents(whole)


def test_without_a_record_a_run_begins_again_with_and_without_resume(tmp_path: Path) -> None:
    """The two pieces of advice must not send the user from one to the other."""
    for resume in (False, True):
        path = tmp_path / f"run{resume}"
        with killed_at(4), pytest.raises(KilledError):
            fitted(path)
        assert (path / files.MODEL).is_file() and not (path / files.FIT).is_file()
        with pytest.raises(UserError) as caught:
            open_run(path)
        assert "begins it again" in str(caught.value.diagnostics[0].help)
        target(str(path), resume=resume)
        fitted(path, resume=resume)
        assert open_run(path).fit.finished


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_every_request_to_end_leaves_a_run_that_can_be_used(name: str, tmp_path: Path, whole: Path) -> None:
    # The parent may have left it ignored, as nohup does with SIGHUP, which training respects.
    kept = signal.signal(getattr(signal, name), signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)

    class Asked(Recorder):
        def update(self, update: Any) -> None:
            super().update(update)
            if len(self.updates) == 2:
                os.kill(os.getpid(), getattr(signal, name))

    try:
        with pytest.raises(KeyboardInterrupt):
            train(model_of(MODEL), data(), TrainOptions(**OPTIONS, members=2), tmp_path / "run", Asked())
    finally:
        signal.signal(getattr(signal, name), kept)
    run = open_run(tmp_path / "run")
    assert run.numbers == (0,) and run.fit.constants["k"].value > 1
    fitted(tmp_path / "run", members=2, resume=True)
    assert contents(tmp_path / "run") == contents(whole)


def test_a_second_process_is_refused_until_the_first_has_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.runs.locks.PATIENCE", 0.0)
    path = tmp_path / "run"
    code = (
        "import sys, time; from pathlib import Path; from gbspec.runs import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    assert other.stdout is not None and other.stdout.readline() == b"held\n"
    with pytest.raises(UserError, match="GB864"):
        fitted(path)
    other.kill()
    other.wait()
    with locked(path), locked(path):
        pass
    assert fitted(path).numbers == (0,)


def test_a_full_disk_is_told_and_the_old_file_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gbspec.cli.frame import file_trouble

    path = tmp_path / "table.csv"
    write_bytes(path, b"old")

    def full(self: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError) as caught:
        write_bytes(path, b"new")
    monkeypatch.undo()
    found = file_trouble(caught.value)
    assert found is not None and found.code == "GB805" and "table.csv" in found.message and "no space" in found.message
    assert path.read_bytes() == b"old" and not any(is_aside(p.name) for p in tmp_path.iterdir())
