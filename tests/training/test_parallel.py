"""Worker processes: how many there are, and what they do not do."""

from __future__ import annotations

import os
import sys
from multiprocessing.spawn import get_preparation_data

from gbspec.training.parallel import _without_main, cores


def test_the_users_script_is_not_run_again_in_a_worker() -> None:
    main = sys.modules["__main__"]
    before = dict(vars(main))
    with _without_main():
        told = get_preparation_data("worker")
        assert "init_main_from_name" not in told and "init_main_from_path" not in told
    assert {name: vars(main).get(name) for name in before} == before
    told = get_preparation_data("worker")
    assert "init_main_from_name" in told or "init_main_from_path" in told


def test_cores_are_those_that_may_be_used() -> None:
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert cores() == len(allowed)
