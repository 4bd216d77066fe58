"""Models whose functions are all known: the published least squares are reached."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data.table import read
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import ComputationError, Findings
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DATA = Path(__file__).parents[3] / "shared" / "data"

ALPHA_PINENE = """model alpha_pinene
time t from 0
state y1
state y2
state y3
state y4
state y5
learn p1 = 1e-4 > 0
learn p2 = 1e-4 > 0
learn p3 = 1e-4 > 0
learn p4 = 1e-4 > 0
learn p5 = 1e-4 > 0
y1' = -(p1 + p2)*y1
y2' = p1*y1
y3' = p2*y1 - (p3 + p4)*y3 + p5*y5
y4' = p3*y3
y5' = p4*y3 - p5*y5
initial y1 = 100
initial y2 = 0
initial y3 = 0
initial y4 = 0
initial y5 = 0
observe y1 noise normal(1)
observe y2 noise normal(1)
observe y3 noise normal(1)
observe y4 noise normal(1)
observe y5 noise normal(1)
"""

GAS_OIL = """model gas_oil
time t from 0
state y1
state y2
learn k1 = 1 in [0, 100]
learn k2 = 1 in [0, 100]
learn k3 = 1 in [0, 100]
y1' = -(k1 + k3)*y1^2
y2' = k1*y1^2 - k2*y2
initial y1 = 1
initial y2 = 0
observe y1 noise normal(1)
observe y2 noise normal(1)
"""


@pytest.mark.parametrize(
    ("text", "table", "expected"),
    [
        (ALPHA_PINENE, "alpha_pinene.csv", 19.872),
        (GAS_OIL, "gas_oil.csv", 0.0052366),
    ],
)
def test_reaches_the_published_sum_of_squares(text: str, table: str, expected: float, tmp_path: Path) -> None:
    if not (DATA / table).is_file():
        pytest.skip(f"the table {table} is not there")
    model, findings = model_of(text), Findings()
    data = read(DATA / table, model, findings)
    run = train(model, data, TrainOptions(), tmp_path / "run")
    counts = np.isfinite(data.items[0].values).sum(axis=0)
    rmse = run.fit.members[0].rmse
    total = sum(n * rmse[name] ** 2 for n, name in zip(counts, data.channels, strict=True))
    assert total == pytest.approx(expected, rel=1e-4)


DECAY = """model decay
time t from 0
state x
learn k in [1e-5, 1e5] = {start}
x' = -k*x
initial x = 1
observe x
"""


@pytest.mark.parametrize("start", ["0.03", "2e-5", "1e-5", "1e5"])
def test_exact_data_give_the_exact_constant_from_any_start(start: str, tmp_path: Path) -> None:
    times = np.linspace(0.1, 3, 12)
    data = Trajectories((trajectory("1", 0.0, times, np.exp(-0.5 * times)[:, None], []),), ("x",))
    options = TrainOptions(effort="low", max_step=0.03, solver="rk4")
    fit = train(model_of(DECAY.format(start=start)), data, options, tmp_path / "r").fit
    assert fit.constants["k"].value == pytest.approx(0.5, rel=1e-8)
    assert fit.constants["k"].start == pytest.approx(float(start), rel=1e-11)
    assert not [warning for warning in fit.warnings if "bound" in warning]


THRESHOLD = """model threshold
time t from 0
state x
learn level in [0, 10] = 9.9
learn gain in [1e-3, 1e3]
x' = gain*max(x - level, 0) - x
initial x = 8
observe x
"""


def test_a_constant_without_influence_at_its_start_is_found(tmp_path: Path) -> None:
    """At the start the threshold is never reached, so that nothing depends on it."""
    times = np.linspace(0.2, 3, 15)
    values = 8 * np.exp(-0.5 * times)  # level 0, gain 1/2
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    fit = train(model_of(THRESHOLD), data, TrainOptions(max_step=0.05, effort="low", solver="rk4"), tmp_path / "r").fit
    assert fit.members[0].rmse["x"] is not None and fit.members[0].rmse["x"] < 1e-4
    (search,) = [stage for stage in fit.members[0].stages if stage.name == "search"]
    assert search.remark is not None and "the best minimum found" in search.remark


OSCILLATOR = """model driven
time t from 0
state x
state v
learn a in [1e-3, 1e3]
learn w in [1e-3, 1e3]
x' = v
v' = -x + a*cos(w*t)
initial x = 1
initial v = 0
observe x
"""


def test_the_search_goes_on_while_residuals_follow_one_another(tmp_path: Path) -> None:
    """Most starts lead to a frequency that is wrong, and to the same minimum."""
    times = np.linspace(0.25, 12, 48)
    forced = 0.8 / (1 - 1.3**2) * (np.cos(1.3 * times) - np.cos(times))
    values = np.cos(times) + forced + 0.02 * np.random.default_rng(0).standard_normal(len(times))
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    fit = train(model_of(OSCILLATOR), data, TrainOptions(threads=1, solver="rk4"), tmp_path / "r").fit
    assert [fit.constants[name].value for name in "aw"] == pytest.approx([0.8, 1.3], rel=0.05)


def test_draws_that_blow_up_are_discarded(tmp_path: Path) -> None:
    """Growth without bound from nearly all constants that the bounds allow, the declared ones among them."""
    text = DECAY.replace("-k*x", "k*x^2 - x").format(start="1e3")
    times = np.linspace(0.2, 3, 15)
    values = 1 / (0.5 + 0.5 * np.exp(times))  # k = 0.5
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    fit = train(model_of(text), data, TrainOptions(effort="low", max_step=0.05, solver="rk4"), tmp_path / "r").fit
    assert fit.constants["k"].value == pytest.approx(0.5, rel=1e-4)


def test_a_model_that_no_start_solves_says_where_and_why(tmp_path: Path) -> None:
    text = DECAY.replace("-k*x", "exp(exp(exp(k*x + 10)))").format(start="1")
    data = Trajectories((trajectory("one", 0.0, [1.0], [[0.5]], []),), ("x",))
    with pytest.raises(ComputationError, match="cannot be solved from any of 66 starts") as caught:
        train(model_of(text), data, TrainOptions(effort="low"), tmp_path / "r")
    assert "x'" in caught.value.what and "`one`" in str(caught.value.where)


def test_small_errors_of_first_values_that_grow_are_not_believed(tmp_path: Path) -> None:
    """Noise of 0.15 % of the deviations is 3 % of the first value, with which the whole solution is multiplied."""
    times = np.linspace(0, 4, 21)
    noise = 0.02 * np.random.default_rng(3).standard_normal(21)
    noise[0] = 0.03
    text = "model growth\nstate x\nlearn r = 0.5 in [0, 5]\nx' = r*x\nobserve x\n"
    data = Trajectories((trajectory("one", 0.0, times, (np.exp(times) + noise)[:, None], []),), ("x",))
    fit = train(model_of(text), data, TrainOptions(), tmp_path / "run").fit
    assert fit.constants["r"].value == pytest.approx(1, abs=1e-3)
    assert [stage.name for stage in fit.members[0].stages].count("least squares, starts too") == 1
