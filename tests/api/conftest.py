"""A model of one state with units, a condition and a truth, for tests of the Python interface."""

from __future__ import annotations

import pytest

import gbspec

DECAY = """model decay "Decay of a substance"
time t : h
state x : g in [0, 10] "amount"
condition T in [280, 320] "temperature"
learn k : 1/h = 0.3 in [0, 5] "rate"
truth k = 0.5
x' = -k*x
observe x
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> gbspec.Specification:
    path = tmp_path_factory.mktemp("model") / "decay.gb"
    path.write_text(DECAY, encoding="utf-8")
    return gbspec.load(path)
