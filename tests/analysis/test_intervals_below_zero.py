"""Predictions beyond what is declared: intervals of what cannot be negative, and states far outside of their ranges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gbspec.analysis.prediction.below_zero import said_of_ends
from gbspec.analysis.prediction.far_outside import said_of_states
from gbspec.analysis.prediction.forecast import Forecast, forecast, hidden_states
from gbspec.data import Trajectories
from gbspec.passes import never_negative
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = "model m\ntime t from 0\nstate x in {range}\nlearn k = 0.5 in [0.05, 5]\nx' = -k*x\ninitial x = 10\n"


def predicted(tmp_path: Path, observed: str, range_: str = "[0, 20]") -> Forecast:
    """A decay to zero, measured with a noise of 2 in the long run (of 30 % where the noise is log-normal)."""
    times = np.linspace(0.2, 8, 20)
    random, made = np.random.default_rng(0), []
    for label in "ab":
        noise = random.standard_normal(20)
        clean = 10 * np.exp(-0.6 * times)
        values = clean * np.exp(0.3 * noise) if "lognormal" in observed else clean + 2 * noise
        made.append(trajectory(label, 0.0, times, values[:, None], []))
    model = model_of(DECAY.format(range=range_) + observed + "\n")
    names = (model.channels[0].name,)
    run = train(model, Trajectories((made[0],), names), TrainOptions(effort="low"), tmp_path / "run")
    return forecast(run, Trajectories((replace(made[1], label="new"),), names))


def test_ends_below_zero_are_told_and_not_cut_off(tmp_path: Path) -> None:
    found = predicted(tmp_path, "observe x")
    (said,) = [text for text in found.warnings if "below zero" in text]
    low = found.items[0].low[:, 0]
    assert low.min() < -1, "the interval is that of a measurement, which may be negative"
    assert f"`x` go below zero in {(low < 0).sum()} of 20 rows (to {low.min():.3g})" in said
    assert "noise lognormal(" in said


class Ends:
    """A prediction whose interval goes below zero."""

    failure, mean, low = "", np.array([[0.1], [3.0]]), np.array([[-1.0], [2.0]])
    high = 2 * mean - low


@pytest.mark.parametrize(
    ("observed", "bounds", "said"),
    [
        ("observe x", "[0, 3.5]", ". Upper ends lie beyond the declared range, [0, 3.5], in 1 of 2 rows (to 4)"),
        ("observe y = x", "[0, 1]", ". Upper ends lie beyond the declared range, [0, 1], in 2 of 2 rows (to 4)"),
        ("observe x", "[0, 3.9]", ""),
        ("observe q = k*x", "[0, 1]", ""),
    ],
)
def test_upper_ends_beyond_the_declared_range_are_told_with_them(observed: str, bounds: str, said: str) -> None:
    (found,) = said_of_ends(model_of(DECAY.format(range=bounds) + observed + "\n"), [Ends()], [])
    assert found.endswith(said) if said else "Upper" not in found


@pytest.mark.parametrize(
    ("observed", "why", "remedy"),
    [
        ("observe x", "by its declared range it does not", True),
        ("observe y = x", "by the declared range of `x`, which it measures, it does not", True),
        ("observe q = k*x", "by the declared ranges of what it is computed from it cannot", True),
        ("observe l = log(x + 1)", "by the declared ranges of what it is computed from it cannot", False),
    ],
)
def test_only_declared_ranges_are_named_and_logarithms_get_no_logarithms(observed: str, why: str, remedy: bool) -> None:
    (said,) = said_of_ends(model_of(DECAY.format(range="[0, 20]") + observed + "\n"), [Ends()], [])
    assert f"although {why}: they are" in said
    assert ("lognormal" in said) == remedy


@pytest.mark.parametrize(
    ("observed", "range_"),
    [("observe x noise lognormal(0.3)", "[0, 20]"), ("observe x", "[-20, 20]"), ("observe d = x - 5", "[0, 20]")],
)
def test_nothing_is_said_of_what_may_be_negative_or_stays_above(tmp_path: Path, observed: str, range_: str) -> None:
    assert not [text for text in predicted(tmp_path, observed, range_).warnings if "below zero" in text]


@pytest.mark.parametrize(
    ("value", "never"),
    [("a", True), ("a + 2*b", True), ("a*b/(1 + a)", True), ("a - b", False), ("c", False), ("k*a", True)],
)
def test_what_a_model_declares_never_to_be_negative(value: str, never: bool) -> None:
    model = model_of(
        "model m\nstate a in [0, 9]\nstate b in [0, 9]\nstate c\nlearn k = 1 > 0\na' = -k*a\nb' = k*a - b\nc' = -c\n"
        f"observe c\nobserve y = {value}\n"
    )
    assert never_negative(model, model.channels[1].value) == never


def test_predicted_states_far_outside_of_their_range_are_told(tmp_path: Path) -> None:
    """As `train` and `validate` tell them; here the start is declared beyond the range."""
    far = [text for text in predicted(tmp_path, "observe x", "[0, 5]").warnings if "far outside of its range" in text]
    (said,) = far
    assert said.startswith("`x`: ")
    assert "of 20 values lie far outside of its range [0, 5]: from " in said
    assert said.endswith("(a longer `--window`) may determine it")


def test_states_behind_the_channels_are_looked_at_too() -> None:
    model = model_of(
        "model m\nstate a in [0, 9]\nstate b in [0, 9]\nlearn k = 1 > 0\na' = -k*a\nb' = k*a - b\nobserve y = 2*a\n"
        "observe b\n"
    )
    means = np.array([[40.0, 3.0, 20.0], [4.0, 3.0, 2.0]])  # y, b, and a, which no channel names
    low = 0 * means
    items = [SimpleNamespace(failure="", mean=means, low=low), SimpleNamespace(failure="no", mean=9 * means, low=low)]
    (said,) = said_of_states(model, items, hidden_states(model))
    assert said.startswith("`a`: 1 of 2 values lies far outside of its range [0, 9]: 20.")
    assert said_of_states(model, items[1:], (0,)) == []
