"""Members on a cluster: a real scheduler with two worker processes, one of which is killed midway."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from gbspec.diagnostics import UserError
from gbspec.runs import Run, open_run
from gbspec.training import TrainOptions, Update, train
from tests.training.conftest import URP, Recorder, model_of, urp_data

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

# Without a warm start, which is cut short in this process but not in the workers.
OPTIONS = {"members": 3, "warm_start": False, "method": "lm", "epochs": 3, "threads": 1}


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler with two workers of one thread each, which come back when they are killed.

    They are processes of their own, started as a user starts them and killed at the end: nothing waits for them to
    close in order.
    """
    folder = tmp_path_factory.mktemp("scheduler")
    place = folder / "scheduler.json"
    quiet = {
        "DASK_DISTRIBUTED__WORKER__DAEMON": "False",
        "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
        "OMP_NUM_THREADS": "1",
    }
    common = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(place)]
    with ExitStack() as stack:
        for program, options in (("scheduler", ["--port", "0"]), ("worker", ["--nworkers", "2", "--nthreads", "1"])):
            command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *common, *options]
            output = stack.enter_context((folder / f"{program}.log").open("wb"))
            process = subprocess.Popen(
                command, cwd=folder, env=os.environ | quiet, stdout=output, stderr=output, start_new_session=True
            )
            stack.callback(killed, process)
        with distributed.Client(scheduler_file=str(place), timeout=120, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
            address = client.scheduler.address
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("gbspec.training.runs.cluster.PATIENCE", 120)
            yield address


def killed(process: subprocess.Popen[bytes]) -> None:
    """Ends a process and all that it started."""
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def holding(mark: Path) -> Callable[[], None]:
    """A function for workers: the first member 0 that tells of an iteration of its last stage goes no further."""

    def hold() -> None:  # it travels as it is, for a worker does not find this file
        from gbspec.training.runs.jobs import Sender

        tell = Sender.update

        def update(self: Sender, update: Update) -> None:
            here = (update.member, update.stage) == (0, "lm") and not mark.exists()
            if here:
                mark.touch()  # before it tells, since it may be killed as soon as it has told
            tell(self, update)
            if here:
                Event().wait()

        Sender.update = update  # type: ignore[method-assign]  # in the worker's process alone

    return hold


class Killer:
    """Progress that kills the worker of member 0 when this has told of an iteration of its last stage."""

    def __init__(self, address: str, mark: Path) -> None:
        self.client = distributed.Client(address, timeout=120, set_as_default=False)
        self.client.run(holding(mark))
        self.killed: int | None = None
        self.starts: Counter[int] = Counter()
        self.told: set[tuple[int, str, int]] = set()

    def update(self, update: Update) -> None:
        self.starts[update.member] += update.stage == "start"
        self.told.add((update.member, update.stage, update.iteration))
        if self.killed is None and (update.member, update.stage) == (0, "lm"):
            pids = self.client.run(os.getpid)
            for address, keys in self.client.processing().items():
                if any(str(key).endswith("-0") for key in keys):
                    self.killed = 0
                    os.kill(pids[address], signal.SIGKILL)

    def message(self, text: str) -> None:
        """What is said is no matter of this test."""


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run in this process, one member after the other."""
    options = TrainOptions(**OPTIONS, workers=1)  # type: ignore[arg-type]
    return train(model_of(URP), urp_data(4, 2.0, 6), options, tmp_path_factory.mktemp("alone") / "run")


def assert_equal(run: Run, alone: Run) -> None:
    said = ("strongly correlated", "R²", "different minima", "its bounds")
    assert all(any(words in warning for words in said) for warning in run.fit.warnings), run.fit.warnings
    for member in range(3):
        for name, value in alone.member(member).weights.items():
            assert np.array_equal(run.member(member).weights[name], value), name


def test_a_killed_worker_changes_nothing(scheduler: str, alone: Run, tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    killer = Killer(scheduler, tmp_path / "held")
    options = TrainOptions(**OPTIONS, scheduler=scheduler)  # type: ignore[arg-type]
    train(model, data, options, tmp_path / "cluster", killer)
    killer.client.close()
    assert killer.killed == 0
    assert killer.starts == {0: 1, 1: 1, 2: 1}, "the lost member goes on from its checkpoint"
    assert {(member, "lm", 3) for member in range(3)} <= killer.told
    assert_equal(open_run(tmp_path / "cluster"), alone)
    assert not list((tmp_path / "cluster" / "members").glob(".*")), "nothing is left behind"


def test_an_interrupted_run_goes_on_without_the_cluster(scheduler: str, alone: Run, tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    options = TrainOptions(**OPTIONS, scheduler=scheduler)  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        train(model, data, options, tmp_path / "run", Recorder(interrupt_after=1))
    assert open_run(tmp_path / "run").fit.warnings
    run = train(model, data, TrainOptions(**OPTIONS, workers=1, resume=True), tmp_path / "run")  # type: ignore[arg-type]
    assert_equal(run, alone)


def test_a_worker_that_does_not_see_the_directory_sends_its_files(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is written under this name, no worker looks for.
    monkeypatch.setattr("gbspec.training.runs.cluster.TOKEN", ".elsewhere")
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    few = OPTIONS | {"members": 1, "epochs": 1}
    alone = train(model, data, TrainOptions(**few), tmp_path / "alone")  # type: ignore[arg-type]
    options = TrainOptions(**few, scheduler=scheduler)  # type: ignore[arg-type]
    run = train(model, data, options, tmp_path / "cluster")
    assert np.array_equal(run.member().weights["constants"], alone.member().weights["constants"])
    written = {path.name for path in (tmp_path / "cluster" / "members" / "0").iterdir()}
    assert written == {path.name for path in (tmp_path / "alone" / "members" / "0").iterdir()}


def test_no_scheduler_is_the_users_mistake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.runs.cluster.PATIENCE", 0.2)
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    with pytest.raises(UserError, match=r"GB860.*no scheduler answers at `tcp://127.0.0.1:1`"):
        train(model, data, TrainOptions(scheduler="tcp://127.0.0.1:1"), tmp_path / "run")
    with pytest.raises(UserError, match=r"GB850.*--scheduler nowhere"):
        train(model, data, TrainOptions(scheduler="nowhere"), tmp_path / "other")
    assert not (tmp_path / "other").exists()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match=r"GB860.*is not installed"):
        train(model, data, TrainOptions(scheduler="tcp://127.0.0.1:1"), tmp_path / "another")
