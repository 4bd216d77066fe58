"""The covariance of weights and constants at the end of a fit, and what a run keeps of it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gbspec.analysis import fences, function_bands
from gbspec.analysis.prediction.displaced import Displaced, variance_of
from gbspec.analysis.prediction.solutions import Start
from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import read
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings
from gbspec.runs import Certainties, Covariance, Support, files, read_certainties
from gbspec.training import TrainOptions, train
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.optimise import curvature as module
from gbspec.training.optimise.curvature import covariance
from gbspec.training.optimise.levenberg_marquardt import WEAK
from gbspec.training.optimise.normal_equations import huber_weights
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, trajectory, urp_data
from tests.training.reference import linearise, whole_jacobian

RIDGE, VARIANCE = 0.02, 0.3


@pytest.mark.parametrize("text", [URP, EVERYTHING])
@pytest.mark.parametrize("dense", [True, False])
def test_it_is_the_inverse_of_the_normal_matrix(text: str, dense: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    data = urp_data(3, 2.0, 1) if text == URP else everything_data()
    problem, parameters, theta = problem_of(model_of(text), data, 0.2)
    monkeypatch.setattr(module, "_evidence", lambda *_: (RIDGE, VARIANCE))
    monkeypatch.setattr(module, "of_estimates", lambda *_: 1.0)  # has tests of its own
    if not dense:
        monkeypatch.setattr(module, "DENSE", 0)
        monkeypatch.setattr(module, "RANK", min(60, parameters.n_weights))
    found = covariance(TorchEngine(problem, parameters), theta)
    assert found is not None

    system = linearise(problem, parameters, theta)
    residuals = system.residuals.numpy()
    delta = max(4 * np.median(np.abs(residuals)), 3e-3)
    jacobian = whole_jacobian(system, parameters).numpy()
    diagonal = np.full(parameters.size, WEAK * np.mean(residuals**2))
    diagonal[: parameters.n_weights] = RIDGE
    normal = jacobian.T @ (huber_weights(residuals, float(delta))[:, None] * jacobian) + np.diag(diagonal)
    n, total = parameters.n_weights, parameters.n_shared
    whole = VARIANCE * np.linalg.inv(normal)[:total, :total]
    slopes = parameters.bijections(parameters.shared).derivative(theta[n:total])
    for derivative in np.random.default_rng(0).standard_normal((5, total)):
        weights, constants = derivative[None, :n], derivative[None, n:]
        expected = np.concatenate([derivative[:n], derivative[n:] * slopes])
        (deviation,) = found.deviations(weights, constants)
        exact = np.sqrt(expected @ whole @ expected)
        assert deviation == pytest.approx(exact, rel=1e-3), "directions that are left out keep the prior's variance"
        assert deviation >= exact * (1 - 1e-9)


def six_parameters() -> Covariance:
    """A covariance of five weights, two directions of which the data show, and of a constant coupled to them."""
    vectors = np.linalg.qr(np.random.default_rng(0).standard_normal((5, 2)))[0].T
    return Covariance(("w",), ("k",), 0.5, vectors, np.array([0.1, 0.01]), np.ones((1, 5)), np.array([[0.2]]))


def mean_squares(known: Covariance, most: int) -> np.ndarray:
    drawn = np.array([np.concatenate(one) for one in known.displacements(np.random.default_rng(1), most)])
    assert len(drawn) <= most
    return drawn.T @ drawn / len(drawn)


def test_displacements_are_drawn_from_it() -> None:
    known = six_parameters()
    chunks = [known.displacements(np.random.default_rng(seed), 5) for seed in range(800)]
    drawn = np.array([np.concatenate(one) for chunk in chunks for one in chunk])
    sample = drawn.T @ drawn / len(drawn)
    for derivative in np.eye(6):
        (deviation,) = known.deviations(derivative[None, :5], derivative[None, 5:])
        assert np.sqrt(sample @ derivative @ derivative) == pytest.approx(deviation, rel=0.1)


def test_few_parameters_are_displaced_along_a_square_root_of_it() -> None:
    known = six_parameters()
    sample = mean_squares(known, 16)
    for derivative in np.random.default_rng(2).standard_normal((9, 6)):
        (deviation,) = known.deviations(derivative[None, :5], derivative[None, 5:])
        assert np.sqrt(sample @ derivative @ derivative) == pytest.approx(deviation, rel=1e-12)


def test_a_constant_without_variance_costs_no_displacement() -> None:
    conditional = np.diag([0.2, 0.0, 0.3])
    empty = np.zeros((0, 0))
    known = Covariance((), ("a", "b", "c"), 1.0, empty, np.zeros(0), np.zeros((3, 0)), conditional)
    assert len(known.displacements(np.random.default_rng(0), 16)) == 2
    assert mean_squares(known, 16) == pytest.approx(conditional, abs=1e-14)


def test_a_displaced_solution_that_does_not_exist_is_sought_nearer() -> None:
    """Without the first constant, which tells most, a variance of 4 would be left of 12."""
    shares = np.array([3.0, 1.0, 1.0, 1.0])
    names = ("a", "b", "c", "d")
    known = Covariance((), names, 1.0, np.zeros((0, 0)), np.zeros(0), np.zeros((4, 0)), np.eye(4))
    module = SimpleNamespace(constants=names, weights={}, info={}, shapes=dict)
    displaced = Displaced(module, known)  # type: ignore[arg-type]  # what it needs of a member
    far = 0.5 * 1e-2 * np.sqrt(4)

    def solve(_: object, start: Start) -> Array:
        found = float(shares @ start.constants)
        return np.array([[found if abs(start.constants[0]) < far else np.nan]])

    displaced._displaced = lambda weights, constants: (None, constants)  # type: ignore[method-assign,assignment,return-value]
    start = Start(np.zeros(0), np.zeros(4), "known")
    none = np.zeros((1, 1))
    assert variance_of(none, displaced.slopes(start, none, solve)) == pytest.approx(12.0, rel=1e-6)


@pytest.mark.parametrize("edge", [0.0, 5e-5, 0.004])
def test_a_jump_beside_the_estimate_is_no_derivative(edge: float) -> None:
    """A row that an event passes at this displacement of a constant has the derivative on this side of it."""
    known = Covariance((), ("a",), 1.0, np.zeros((0, 0)), np.zeros(0), np.zeros((1, 0)), np.array([[0.25]]))
    module = SimpleNamespace(constants=("a",), weights={}, info={}, shapes=dict)
    displaced = Displaced(module, known, jumping=True)  # type: ignore[arg-type]  # what it needs of a member
    displaced._displaced = lambda weights, constants: (None, constants)  # type: ignore[method-assign,assignment,return-value]

    def solve(_: object, start: Start) -> Array:
        a = float(start.constants[0])
        return np.array([[3.0 * a + (7.0 if a > edge else 0.0), 2.0 * a]])

    start = Start(np.zeros(0), np.zeros(1), "known")
    here = solve(None, start)
    found = variance_of(here, displaced.slopes(start, here, solve))
    assert found == pytest.approx(np.array([[9.0, 4.0]]) * 0.25, rel=1e-6)


@pytest.mark.parametrize(("edge", "low", "high"), [(0.3, 0.0, 9.4675), (-0.3, -2.4675, 7.0), (2.0, 0.0, 0.0)])
def test_a_row_that_an_event_may_pass_has_both_sides(edge: float, low: float, high: float) -> None:
    """Where the interval of a constant that moves the event, -0.82 to 0.82, contains the time at which it passes."""
    known = Covariance((), ("a",), 1.0, np.zeros((0, 0)), np.zeros(0), np.zeros((1, 0)), np.array([[0.25]]))
    module = SimpleNamespace(constants=("a",), weights={}, info={}, shapes=dict)
    moving = {"a": (-0.8225, 0.8225)}
    displaced = Displaced(module, known, jumping=True, moving=moving)  # type: ignore[arg-type]  # what it needs
    displaced._displaced = lambda weights, constants: (None, constants)  # type: ignore[method-assign,assignment,return-value]

    def solve(_: object, start: Start) -> Array:
        a = float(start.constants[0])
        return np.array([[3.0 * a + (7.0 if a > edge else 0.0), 2.0 * a]])

    start = Start(np.zeros(0), np.zeros(1), "known")
    here = solve(None, start)
    slopes = displaced.slopes(start, here, solve)
    assert variance_of(here, slopes) == pytest.approx(np.array([[9.0, 4.0]]) * 0.25, rel=1e-6)
    found = displaced.passed(start, here, slopes, solve)
    assert np.concatenate(found) == pytest.approx(np.array([[low, 0.0], [high, 0.0]]), rel=1e-3)


def test_what_goes_with_a_constant_that_is_displaced() -> None:
    """Its column of the covariance, over its standard deviation."""
    known = six_parameters()
    sample = mean_squares(known, 16)
    (name,) = known.constants
    found = np.concatenate(known.towards(name))
    assert found == pytest.approx(sample[:, 5] / np.sqrt(sample[5, 5]), rel=1e-10)


def test_constants_may_be_known_besides() -> None:
    """As if they had been measured, which adds to their precision; without an error nothing of them is left."""
    root = np.random.default_rng(0).standard_normal((3, 3))
    own, empty = root @ root.T, np.zeros((0, 0))
    known = Covariance((), ("a", "b", "c"), 1.0, empty, np.zeros(0), np.zeros((3, 0)), own)
    precision = np.linalg.inv(own) + np.diag([0.0, 1 / 0.3**2, 1 / 0.2**2])
    assert known.at_most({"b": 0.3, "c": 0.2}).conditional == pytest.approx(np.linalg.inv(precision), rel=1e-9)
    left = own[0, 0] - own[0, 1:] @ np.linalg.solve(own[1:, 1:], own[1:, 0])
    exact = known.at_most({"b": 0.0, "c": 0.0}).conditional
    assert exact == pytest.approx(np.diag([left, 0.0, 0.0]), rel=1e-9)


def test_weaker_data_leave_more_of_the_prior() -> None:
    rng = np.random.default_rng(0)
    design = rng.standard_normal((3, 5))
    spread = 0.5

    def posterior(noise: float) -> tuple[Covariance, np.ndarray]:
        data = design.T @ design / noise**2
        values, vectors = np.linalg.eigh(data)
        shares = 1 / (1 + spread**2 * values[2:])
        known = Covariance(("w",), (), spread, vectors[:, 2:].T, shares, np.zeros((0, 5)), np.zeros((0, 0)))
        return known, np.linalg.inv(data + np.eye(5) / spread**2)

    known, _ = posterior(0.1)
    _, weaker = posterior(0.7)
    found = known.widened(7.0).deviations(np.eye(5), np.zeros((5, 0)))
    np.testing.assert_allclose(found, np.sqrt(np.diag(weaker)), rtol=1e-8)


def test_it_is_kept_in_a_file(tmp_path: Path) -> None:
    assert read_certainties(tmp_path) == Certainties()
    known = Covariance(("w",), ("k",), 0.5, np.eye(2, 5), np.ones(2), np.ones((1, 5)), np.eye(1))
    Certainties(known, {"f": Support(np.ones((3, 2)), np.arange(3.0))}).write(tmp_path)
    found = read_certainties(tmp_path)
    assert found.covariance is not None
    np.testing.assert_allclose(found.covariance.deviations(np.eye(5), np.ones((5, 1))),
                               known.deviations(np.eye(5), np.ones((5, 1))))  # fmt: skip
    np.testing.assert_array_equal(found.support["f"].points, np.ones((3, 2)))
    (tmp_path / "covariance.safetensors").write_bytes(b"damaged")
    assert read_certainties(tmp_path) == Certainties()


@pytest.mark.parametrize("name", ["vectors", "shares", "coupling", "conditional", "owner.f"])
def test_arrays_that_do_not_fit_each_other_are_damage(tmp_path: Path, name: str) -> None:
    known = Covariance(("w",), ("k",), 0.5, np.eye(2, 5), np.ones(2), np.ones((1, 5)), np.eye(1))
    Certainties(known, {"f": Support(np.ones((3, 2)), np.arange(3.0))}).write(tmp_path)
    arrays, remarks = files.read_tensors(tmp_path / "covariance.safetensors")
    arrays[name] = np.concatenate([arrays[name], arrays[name]])
    files.write_tensors(tmp_path / "covariance.safetensors", arrays, remarks)
    assert read_certainties(tmp_path) == Certainties()


@pytest.mark.parametrize("contract", ["", " >= 0, increasing in b"])
def test_derivatives_of_a_function_by_its_weights(contract: str) -> None:
    text = f"""model f
state a in [0, 2]
state b in [0, 2]
learn s = 0.7
unknown g(a, b) = s*nn by mlp(4, 3){contract}
a' = -g
b' = -b
observe a
observe b
"""
    member = load_module(model_of(text)).random(1)
    points = np.random.default_rng(2).uniform(0, 2, (6, 2))
    slopes = member.function_slopes("g", points)
    assert set(slopes) == {name for name in member.shapes() if name.endswith((".weight", ".bias", "constants"))}
    for name, slope in slopes.items():
        moved = []
        for sign in (1, -1):
            weights = {key: value.copy() for key, value in member.weights.items()}
            weights[name].flat[0] += sign * 1e-6
            other = type(member)(weights)
            moved.append(other.functions["g"](torch.from_numpy(points)).detach().numpy())
        np.testing.assert_allclose(slope.reshape(6, -1)[:, 0], (moved[0] - moved[1]) / 2e-6, rtol=1e-5, atol=1e-9)


def test_a_fit_has_bands_and_fences(tmp_path: Path, quick_fit: None) -> None:
    model = model_of("""model decay
time t from 0
state x in [0, 2]
unknown f(x) >= 0 by mlp(6)
x' = -f
initial x = 1
observe x
""")
    times = np.linspace(0.2, 2, 10)
    noise = 0.02 * np.random.default_rng(0).standard_normal((2, 10))
    items = [trajectory(str(i), 0.0, times, (np.exp(-times) + noise[i])[:, None], []) for i in range(2)]
    run = train(model, Trajectories(tuple(items), ("x",)), TrainOptions(effort="low", max_step=0.1), tmp_path / "run")
    points = np.array([[0.2], [0.5], [0.9], [3.0]])
    value, low, high = function_bands(run, "f", points)
    assert np.all((low <= value) & (value <= high) & (low >= 0))
    width = high - low
    assert 0.005 < width[1] < 0.5
    assert width[3] > 5 * width[1], "it widens where there are no data"
    start = Start(np.zeros(1), np.zeros(0), "known")
    displaced = Displaced(run.member(), run.certainties().covariance)
    slopes = displaced.slopes(start, value[:, None], lambda one, _: one.functions_many("f", points)[:, None])
    variance = variance_of(value[:, None], slopes)
    ratio = 1.645 * np.sqrt(variance[1:3, 0]) / (high - value)[1:3]
    assert np.all((ratio > 0.5) & (ratio < 1.6)), "draws stay in the linear range"
    fence = fences(run)["f"]
    assert fence.beyond(points).tolist() == [False, False, False, True]


def test_arguments_between_rows_are_known(tmp_path: Path) -> None:
    """The input passes 5 between the start and the first row, and between two rows, and is near 0 at all rows."""
    text = """model driven
time t from 0
input u linear
state x
unknown f(u) by mlp(3)
x' = f - x
initial x = 1
observe x
"""
    rows = ["t,u,x", "0,4,", "1,0,0.5", "2,0.1,0.4", "2.5,5,", "3,0.2,0.5", "4,0,0.4", "5,0,0.45"]
    (tmp_path / "data.csv").write_text("\n".join(rows) + "\n")
    model = model_of(text)
    run = train(model, read(tmp_path / "data.csv", model, Findings()), TrainOptions(effort="low"), tmp_path / "run")
    points = np.sort(run.certainties().support["f"].points[:, 0])
    assert points.min() == 0 and points[-2:] == pytest.approx([4, 5])
    assert ((points > 2) & (points < 3.5)).any()
