"""The arguments with which a model calls its networks: at points, for arrays of states, at points of contracts."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec import frontend
from gbspec.arrays import Array
from gbspec.backends import load_module, network_arguments
from gbspec.diagnostics import Findings, Source
from gbspec.ir import Model

ARRAY = """model line
const N = 3
state u[1..N] in [0, 1] = 0.5
unknown g(u, v) by mlp(4)
u[i]' = g(u[i], 2) + u[i-1] - 2*u[i] + u[i+1]
u[0] = u[1]
u[N+1] = u[N]
observe u
"""
PLAIN = """model plain
state x in [0, 1] = 0.5
state y in [0, 1] = 0.5
unknown g(a in [0, 1]) zero at a = 0 by mlp(4)
x' = g(x) - g(y)
y' = -y
observe x
"""


def model_of(text: str) -> Model:
    return frontend.load_model("m.gb", Findings(), lambda _: Source("m.gb", text))


def recorded(text: str, states: Array) -> list[Array]:
    count = len(states)
    nothing = np.zeros((count, 0))
    member = load_module(model_of(text)).random(0)
    (calls,) = network_arguments(member, np.zeros(count), states, nothing, nothing, nothing)
    return calls


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_call_for_an_array_is_one_for_each_element(count: int) -> None:
    states = np.random.default_rng(0).uniform(size=(count, 3))
    calls = recorded(ARRAY, states)
    assert [call.shape for call in calls] == [(count, 2)] * 3
    for element, call in enumerate(calls):
        assert np.array_equal(call[:, 0], states[:, element]) and np.all(call[:, 1] == 2)


@pytest.mark.parametrize("count", [1, 4])
def test_calls_at_points_are_kept_and_those_of_a_contract_are_not(count: int) -> None:
    states = np.random.default_rng(0).uniform(size=(count, 2))
    calls = recorded(PLAIN, states)
    assert sorted(tuple(call[:, 0]) for call in calls) == sorted(map(tuple, states.T))
