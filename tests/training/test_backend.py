"""`--backend auto` with few data: both backends are measured, once for a run, and the run keeps to the faster one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gbspec.backends import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.runs import BackendRecord
from gbspec.training import TrainOptions, train
from gbspec.training.engines import Choice, Engine
from gbspec.training.problem import Parameters, Problem
from gbspec.training.runs.backend import faster_backend
from tests import quick
from tests.training.conftest import URP, Recorder, model_of, urp_data

QUICK: dict[str, Any] = {"method": "lm", "epochs": 2, "max_step": 0.2, "workers": 1, "warm_start": False, "threads": 1}


class Clock:
    """Seconds that pass only while an engine is used: so many by the torch graph, so many by the kernel."""

    def __init__(self) -> None:
        self.now, self.torch, self.native = 0.0, 4.0, 0.02
        self.made: list[str] = []

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, kernels: Path) -> Iterator[Clock]:
    """Both backends measured by a clock of our own; engines are noted as they are made."""
    clock, engine = Clock(), Choice.engine

    def noted(choice: Choice, problem: Problem, parameters: Parameters) -> Engine:
        clock.made.append("torch" if choice.kernel is None else "native")
        return engine(choice, problem, parameters)

    def passing(work: Any) -> Any:
        def used(*given: Any) -> Any:
            clock.now += clock.torch if clock.made[-1] == "torch" else clock.native
            return work(*given)

        return used

    from gbspec.training.runs import backend

    monkeypatch.setattr("gbspec.training.runs.fit.faster_backend", faster_backend)
    monkeypatch.setattr(Choice, "engine", noted)
    monkeypatch.setattr(backend, "clock", clock)
    monkeypatch.setattr(backend, "linearise", passing(backend.linearise))
    monkeypatch.setattr(backend, "predicted", passing(backend.predicted))
    with quick.kernels(kernels):
        yield clock


@pytest.fixture
def compiler() -> None:
    try:
        find_compiler()
    except CompilerError as error:
        pytest.skip(str(error))


def fitted(path: Path, heard: Recorder | None = None, **more: Any) -> tuple[BackendRecord | None, list[str]]:
    """The record of the backend of a fit, and the messages."""
    heard = heard or Recorder()
    run = train(model_of(URP), urp_data(3, 1.0, 1), TrainOptions(**QUICK | more), path, heard)
    return run.fit.backend, heard.messages


@pytest.mark.usefixtures("compiler")
def test_a_fit_that_is_long_by_the_graph_uses_the_kernel(tmp_path: Path, clock: Clock) -> None:
    found, messages = fitted(tmp_path / "run", members=2)
    assert found == BackendRecord("native", 4.0, pytest.approx(0.02))  # half of two iterations
    said = "measured for a moment, a fit would take about 4 s by the torch graph and 0.02 s by the kernel"
    assert messages[0] == f"the compiled kernel is used: {said}"
    clock.made.clear()
    fitted(tmp_path / "again")
    assert set(clock.made[2:]) == {"native"}
    written = json.loads((tmp_path / "run/fit.json").read_text())
    assert written["backend"]["used"] == "native"
    assert written["options"]["backend"] == "auto"


@pytest.mark.usefixtures("compiler")
def test_the_graph_serves_where_it_is_faster(tmp_path: Path, clock: Clock) -> None:
    clock.native = 10.0
    found, messages = fitted(tmp_path / "run")
    assert found == BackendRecord("torch", 4.0, 10.0)
    assert messages[0].startswith("the torch graph is used: measured")


def test_a_short_fit_compiles_nothing(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.engines.choice.kernel_of", None)
    clock.torch = 2.9
    found, messages = fitted(tmp_path / "run")
    assert found is None
    assert set(clock.made) == {"torch"}
    assert not any("is used" in text for text in messages)


def test_what_is_named_is_not_measured(tmp_path: Path, clock: Clock) -> None:
    assert fitted(tmp_path / "run", backend="torch")[0] is None
    assert clock.now == 0


def test_without_a_compiler_the_graph_serves(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(source: str) -> Any:
        raise CompilerError("there is no C compiler (cc, gcc, clang)")

    monkeypatch.setattr("gbspec.backends.native.library.compiled", missing)
    found, messages = fitted(tmp_path / "run")
    assert found is None
    assert messages[0] == "the torch graph is used: there is no C compiler (cc, gcc, clang)"
    assert set(clock.made) == {"torch"}


@pytest.mark.usefixtures("compiler")
def test_a_run_is_resumed_by_the_backend_with_which_it_was_begun(tmp_path: Path, clock: Clock) -> None:
    fitted(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        fitted(tmp_path / "parts", Recorder(interrupt_after=3))
    clock.torch = 1e-6  # measured now, the graph would be chosen
    clock.made.clear()
    found, _ = fitted(tmp_path / "parts", resume=True)
    assert found is not None
    assert found.used == "native"
    assert set(clock.made) == {"native"}
    one, other = (weights(tmp_path / name) for name in ("whole", "parts"))
    assert all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.usefixtures("compiler", "clock")
def test_a_run_is_resumed_where_there_is_no_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gbspec.backends.module import load_module
    from gbspec.training.engines.engine import Lack, Unable
    from gbspec.training.runs.backend import agreed

    model = model_of(URP)
    monkeypatch.setattr("gbspec.training.engines.choice.kernel_of", lambda *given: Unable(Lack.COMPILER, "none"))
    options, found = TrainOptions(), BackendRecord("native", 4.0, 0.02)
    assert agreed(found, model, load_module(model), options) == replace(options, backend="torch")


def weights(run: Path) -> dict[str, Any]:
    """The arrays of the first member."""
    from gbspec.runs import files

    return files.read_tensors(files.member_directory(run, 0) / files.WEIGHTS)[0]


@pytest.mark.usefixtures("compiler")
def test_whole_solutions_that_take_long_by_the_graph_spare_its_jacobian(tmp_path: Path, clock: Clock) -> None:
    clock.torch = 1e3
    more = {"method": "auto", "warm_start": True, "stages": "teacher forcing; autoregressive"}
    found, messages = fitted(tmp_path / "run", **more)
    assert found is not None and found.used == "native"
    assert "more than" in messages[0]
    assert clock.made[0] == "torch" and clock.made[1] == "native", "one engine of the graph alone"
