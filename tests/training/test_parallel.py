"""Worker processes: how many there are, and what they do not do."""

from __future__ import annotations

import os
import sys
from multiprocessing.spawn import get_preparation_data
from types import ModuleType

import pytest

from gbspec.training.parallel import _without_main, cores


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
