"""`--start RUN`: the networks and constants of an earlier run, by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import UserError
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = """model decay
state x in [0, 4]
learn k = 0.1 in [0, 2]
unknown f(x) by mlp(6)
x' = -k*x + 0.1*f(x)
observe x
allow GB401
"""


def data() -> Trajectories:
    times = np.arange(0.0, 4.0, 0.4)
    items = [trajectory(str(i), 0.0, times, (2.0 + i) * np.exp(-0.7 * times)[:, None], []) for i in range(2)]
    return Trajectories(tuple(items), ("x",))


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Run:
    place = tmp_path_factory.mktemp("first") / "run"
    return train(model_of(DECAY), data(), TrainOptions(method="lm", epochs=6, workers=1, seed=3), place)


def started(text: str, run: Run, place: Path) -> Run:
    """The start alone: no optimiser changes it."""
    options = TrainOptions(method="gradient-matching", warm_start=False, workers=1, start=str(run.path))
    return train(model_of(text), data(), options, place)


def test_networks_with_their_scales_and_constants_are_those_of_the_run(first: Run, tmp_path: Path) -> None:
    again = started(DECAY, first, tmp_path / "again").member()
    for name, value in first.member().weights.items():
        if name.startswith("network."):
            assert np.allclose(again.weights[name], value, rtol=1e-14, atol=0), name
    assert np.allclose(again.weights["constants"], first.member().weights["constants"], rtol=1e-12)


def test_what_the_run_does_not_have_starts_as_usual(first: Run, tmp_path: Path) -> None:
    wider = DECAY.replace("x' = ", "learn c = 0.25 in [0, 1]\nunknown g(x) by mlp(5)\nx' = c*g(x) + ")
    again = started(wider, first, tmp_path / "again").member()
    values = dict(zip(again.constants, again.weights["constants"], strict=True))
    assert values["k"] == pytest.approx(first.fit.constants["k"].value, rel=1e-12) and "c" in values
    assert np.allclose(again.weights["network.f.0.weight"], first.member().weights["network.f.0.weight"], rtol=1e-14)
    # a value out of the bounds that the model now has is not taken
    narrow = DECAY.replace("k = 0.1 in [0, 2]", "k = 1.8 in [1.7, 2]")
    found = started(narrow, first, tmp_path / "narrow").fit.constants
    assert 1.7 <= found["k"].value <= 2


def test_a_fit_from_its_own_result_stays_there(first: Run, tmp_path: Path) -> None:
    run = train(model_of(DECAY), data(), TrainOptions(method="lm", epochs=2, start=str(first.path)), tmp_path / "run")
    (now,), (before,) = run.fit.members, first.fit.members
    assert now.loss is not None and before.loss is not None and now.loss <= before.loss * (1 + 1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (DECAY.replace("mlp(6)", "mlp(7)"), "network `f` has other layers there than in `decay`"),
        ("model other\nstate x\nlearn rate = 1 in [0, 2]\nx' = -rate*x\nobserve x\n", "it has neither networks nor"),
    ],
)
def test_another_model_is_refused(text: str, said: str, first: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="GB867") as caught:
        train(model_of(text), data(), TrainOptions(start=str(first.path)), tmp_path / "run")
    assert said in caught.value.diagnostics[0].message
    assert not (tmp_path / "run").exists()
