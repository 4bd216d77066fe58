"""Worker processes: how many there are, and what they do not do."""

from __future__ import annotations

import os
import sys
from contextlib import nullcontext
from multiprocessing.spawn import get_preparation_data
from pathlib import Path
from queue import Queue
from threading import Event
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import pytest
from safetensors.numpy import load_file

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.training import TrainOptions, train
from gbspec.training.progress import Silent
from gbspec.training.runs.jobs import Job
from gbspec.training.runs.parallel import cores, fit_jobs
from gbspec.training.runs.processes import _without_main
from gbspec.training.runs.summary import MemberResult
from tests.training.conftest import URP, model_of, urp_data


def test_the_users_script_is_not_run_again_in_a_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    main = ModuleType("__main__")  # the one of a script; that of these tests may be a worker itself
    main.__file__ = "script.py"
    monkeypatch.setitem(sys.modules, "__main__", main)
    before = dict(vars(main))
    assert "init_main_from_path" in get_preparation_data("worker")
    with _without_main():
        assert not {"init_main_from_name", "init_main_from_path"} & set(get_preparation_data("worker"))
    assert vars(main) == before


def test_cores_are_those_that_may_be_used() -> None:
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert cores() == len(allowed)


def test_what_a_worker_finds_wrong_comes_back_as_it_is(tmp_path: Path) -> None:
    options: dict[str, Any] = {"members": 2, "warm_start": False, "method": "lm", "epochs": 2}
    model, data, path = model_of(URP), urp_data(4, 2.0, 6), tmp_path / "run"
    train(model, data, TrainOptions(**options, workers=1), path)
    damaged, other = (path / "members" / name / "checkpoint.safetensors" for name in "01")
    damaged.write_bytes(damaged.read_bytes()[:-9])
    with pytest.raises(UserError) as caught:
        train(model, data, TrainOptions(**options, workers=2, resume=True), path)
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB852" and finding.help is not None and "fit the member again" in finding.help
    assert load_file(other), "the other member is kept"


class OneIsWrong:
    """An engine whose first job is wrong; the second goes on until it is told to stop, and gives what it reached."""

    def __init__(self, reached: MemberResult) -> None:
        self.messages: Queue[Any] = Queue()
        self.stopped, self.reached = Event(), reached

    def submit(self, job: Job) -> Any:
        return SimpleNamespace(done=(lambda: True) if job.member == 0 else self.stopped.is_set)

    def outcome(self, pending: Any, job: Job) -> MemberResult | None:
        if job.member == 0:
            raise UserError([Diagnostic("GB852", "the checkpoint is damaged", None)])
        return self.reached

    def stop(self) -> None:
        self.stopped.set()


def test_what_the_others_reached_is_kept_where_a_worker_finds_something_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    reached = cast(MemberResult, object())
    taken: list[tuple[int, object]] = []
    engine = nullcontext(OneIsWrong(reached))
    monkeypatch.setattr("gbspec.training.runs.parallel.processes", lambda workers, threads: engine)
    jobs = cast(list[Job], [SimpleNamespace(member=0), SimpleNamespace(member=1)])
    with pytest.raises(UserError, match="damaged"):
        fit_jobs(jobs, TrainOptions(members=2, workers=2), Silent(), lambda job, what: taken.append((job.member, what)))
    assert taken == [(1, reached)]
