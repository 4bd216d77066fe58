"""Worker processes: how many there are, and what they do not do."""

from __future__ import annotations

import json
import os
import sys
from multiprocessing.spawn import get_preparation_data
from pathlib import Path
from types import ModuleType

import pytest

from gbspec.diagnostics import UserError
from gbspec.training import TrainOptions, train
from gbspec.training.runs.parallel import _without_main, cores
from tests.training.conftest import URP, Recorder, model_of, urp_data


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
    options = {"members": 2, "workers": 2, "method": "lm", "epochs": 2}
    with pytest.raises(KeyboardInterrupt):
        train(model_of(URP), urp_data(4, 2.0, 6), TrainOptions(**options), tmp_path / "run", Recorder(2))  # type: ignore[arg-type]
    damaged = tmp_path / "run" / "members" / "0" / "checkpoint.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    with pytest.raises(UserError) as caught:
        train(model_of(URP), urp_data(4, 2.0, 6), TrainOptions(**options, resume=True), tmp_path / "run")  # type: ignore[arg-type]
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB852" and finding.help is not None and "fit the member again" in finding.help
    fit = json.loads((tmp_path / "run" / "fit.json").read_text())
    assert len(fit["members"]) == 1, "the other member was kept"
