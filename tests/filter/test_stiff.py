"""Stiff models with random disturbances: moments of frozen steps, their gradients, steps that follow a tolerance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.data import Trajectories, read
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir import Model
from gbspec.operations import evaluating
from gbspec.training import TrainOptions, filter_run, train
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.engines.filter import recursion, search
from gbspec.training.engines.filter.division import MOST, joined, refined, trimmed
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.propagator import Matrices, propagators
from gbspec.training.engines.filter.recursion import Moment, predicted
from tests.filter.conftest import BENT, LINEAR, WITH_NETWORK, engine_of, table

FOLLOWING = """model following
time t
state x in [-3, 3] = 1
state y in [-5, 5] = 1
state z in [0, 5] = 1
learn k = 1 in [0.1, 10]
learn rate = {rate} in [1e2, 1e6]
learn s = 0.4 in [0, 5]
learn r = 3 in [0, 50]
x' = y - x - 0.2*z*x
y' = -rate*(y - 2*k*x*(1 - x^2/3))
z' = 0.3*x^2 - 0.5*z
initial x = 0.3
initial y = 0.5
initial z = 0.5
diffusion x = s
diffusion y = r
observe x noise normal(0.1)
observe w = y + z noise normal(0.1)
"""
"""A state y that follows another one at the rate `rate`."""


def waves(step: float, rows: int = 8) -> str:
    return "\n".join(["t,x,w", *(f"{step * i:.2f},{np.sin(i):.3f},{np.cos(i):.3f}" for i in range(rows))]) + "\n"


WAVES = waves(0.2)
DOSED = BENT.replace("initial X learn", "initial X learn\ndose V times theta/2")


def doses(rows: int) -> str:
    lines = table("X V y", rows=rows).splitlines()
    return (
        "\n".join([lines[0] + ",dose_V", *(f"{line},{0.3 if i % 5 == 2 else ''}" for i, line in enumerate(lines[1:]))])
        + "\n"
    )


def stiff(folder: Path, text: str, data: str, tolerance: float | None = None) -> tuple[FilterEngine, Array]:
    """The engine with the stiff solver; without a tolerance each sub-step is one step."""
    engine, vector = engine_of(folder, text, data, solver="ros34pw2", tolerance=tolerance)
    if tolerance is None:
        engine = FilterEngine(replace(engine.problem, control=None), engine.parameters, engine.start_variance)
    return engine, vector


def divided(engine: FilterEngine, vector: Array, steps: int) -> Filtered:
    """The filter with so many equal steps in each leg."""
    *moments, shares = engine.filtered(vector).guess
    return engine.filtered(vector, guess=(*moments, np.full((len(shares), steps), 1 / steps)), held=True)  # type: ignore[arg-type]


def test_propagators_are_the_integrals_of_the_matrix_exponential() -> None:
    f = np.array([[-3.0, 1.0, 0.2], [0.5, -40.0, 2.0], [0.0, 0.3, 0.1]])
    d, h, none = np.diag([0.5, 2.0, 0.0]), 0.3, np.zeros((1, 3, 0, 3))
    found = propagators(Matrices(f[None], none), Matrices(d[None], none), np.array([h]), 3)

    def slopes(s: float, packed: Array) -> Array:
        a, q, j0, j1, j2 = packed.reshape(5, 3, 3)
        parts = f @ a, f @ q + q @ f.T + d, f @ j0 + np.eye(3), f @ j1 + s * np.eye(3), f @ j2 + s**2 * np.eye(3)
        return np.array(parts).ravel()

    begin = np.concatenate([np.eye(3)[None], np.zeros((4, 3, 3))]).ravel()
    exact = solve_ivp(slopes, (0, h), begin, rtol=1e-11, atol=1e-14).y[:, -1].reshape(5, 3, 3)
    assert np.allclose([each.value[0] for each in found], exact, rtol=1e-8, atol=1e-11)


def test_a_frozen_step_is_exact_for_linear_equations(tmp_path: Path) -> None:
    text = LINEAR.replace("X' = -theta*X", "X' = -1e4*theta*X").replace("u in [-2, 2] held", "u in [-2, 2] linear")
    exact, vector = engine_of(tmp_path, text, table("X y"))
    assert exact.exact is not None
    engine, _ = stiff(tmp_path, text, table("X y"))
    engine.__dict__["exact"] = None
    assert engine.value(vector) == pytest.approx(exact.value(vector), rel=1e-11)
    one, other = (each.information(vector).gradient for each in (engine, exact))
    assert np.allclose(one, other, rtol=1e-8, atol=1e-8 * np.abs(other).max())


def test_short_frozen_steps_approach_short_explicit_ones_with_order_two(tmp_path: Path) -> None:
    explicit, vector = engine_of(tmp_path, BENT, table("X V y", rows=8), max_step=0.005)
    engine, _ = stiff(tmp_path, BENT, table("X V y", rows=8))
    expected, errors, gradients = explicit.filtered(vector), [], []
    for steps in (4, 8, 16):
        found = divided(engine, vector, steps)
        errors.append(abs(found.value - expected.value))
        gradients.append(engine.information(vector, found).gradient)
    assert errors[1] < errors[0] / 3.5
    assert errors[2] < errors[1] / 3.5
    assert errors[2] < 1e-3
    gradient = explicit.information(vector, expected).gradient
    assert np.allclose(gradients[2], gradient, atol=1e-3 * np.abs(gradient).max())


def test_one_step_between_rows_is_enough_for_a_stiff_model(tmp_path: Path) -> None:
    """Explicit steps are stable up to 2.8/2000 only, and as long as a tenth of that here."""
    text = FOLLOWING.format(rate="2e3")
    short, vector = engine_of(tmp_path, text, WAVES, max_step=1e-4)
    engine, _ = stiff(tmp_path, text, WAVES)
    expected, found = short.filtered(vector), engine.filtered(vector)
    assert len(engine.legs.owner) == len(found.error)
    assert found.value == pytest.approx(expected.value, rel=3e-4)
    ends = np.flatnonzero(short.legs.row >= 0)
    sd = np.sqrt(np.diagonal(expected.end_cov[ends], axis1=1, axis2=2)) + 1e-3
    assert (np.abs(found.end_mean - expected.end_mean[ends]) < 0.03 * sd).all()
    assert (np.abs(found.end_cov - expected.end_cov[ends]) < 0.01 * sd[:, :, None] * sd[:, None]).all()


def test_a_fast_state_has_the_variance_at_which_it_rests(tmp_path: Path) -> None:
    text = FOLLOWING.format(rate="1e6").replace("x' = y - x - 0.2*z*x", "x' = -x*z")
    engine, vector = stiff(tmp_path, text.replace("diffusion x = s\n", ""), WAVES)
    unseen = engine.filtered(vector, np.zeros_like(engine.problem.valued))
    assert unseen.end_cov[1:, 1, 1] == pytest.approx(3.0**2 / 2e6, rel=1e-2)


def test_covariances_are_positive_whatever_the_step(tmp_path: Path) -> None:
    engine, vector = stiff(tmp_path, FOLLOWING.format(rate="1e4"), waves(2.0, 40))
    rng, index = np.random.default_rng(2), np.flatnonzero(engine.legs.count > 0)
    half = 0.3 * rng.standard_normal((len(index), 3, 3))
    before = Moment(rng.uniform(-2, 2, (len(index), 3)), half @ half.swapaxes(1, 2))
    flow = engine.flows(At.of(engine.layout, engine.layout.split(vector)[0]), index, before)
    end = predicted(before, flow).p
    sound = np.isfinite(end).all(axis=(1, 2))
    assert sound.sum() > 20
    for covariance in (flow.q[sound], end[sound]):
        values = np.linalg.eigvalsh(covariance)
        assert (values >= -1e-12 * values.max(axis=1, keepdims=True)).all()


@pytest.mark.parametrize(
    ("text", "data"),
    [
        (BENT, table("X V y", rows=8)),
        (DOSED, doses(8)),
        (WITH_NETWORK, table("X V y", rows=8)),
        (FOLLOWING.format(rate="1e4"), WAVES),
    ],
    ids=["bent", "dosed", "network", "following"],
)
def test_the_gradient_is_exact_on_the_steps_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, data: str
) -> None:
    monkeypatch.setattr(search, "TOLERANCE", 1e-13)
    engine, vector = stiff(tmp_path, text, data, tolerance=1e-6)
    rng = np.random.default_rng(1)
    vector = vector + 0.05 * rng.standard_normal(len(vector)) * engine.layout.free
    found = engine.filtered(vector)
    assert (found.shares > 0).sum() > len(found.shares) + 3
    gradient = engine.information(vector, found).gradient
    direction, h = rng.standard_normal(len(vector)) * engine.layout.free, 3e-3

    def at(step: float) -> float:
        return engine.filtered(vector + step * h * direction, guess=found.guess, held=True).value

    weights = {1: 45 / 60, 2: -9 / 60, 3: 1 / 60}
    change = sum(weight * (at(step) - at(-step)) for step, weight in weights.items()) / h
    assert gradient @ direction == pytest.approx(change, rel=1e-8, abs=1e-8 * np.abs(gradient).max())


@pytest.mark.parametrize("text", [BENT, FOLLOWING.format(rate="1e4")], ids=["bent", "following"])
def test_the_fast_ways_are_the_plain_ones(tmp_path: Path, text: str) -> None:
    """The compiled recursion is that of numpy, and forward mode that of torch."""
    fast, vector = stiff(tmp_path, text, table("X V y", rows=8) if text is BENT else WAVES, tolerance=1e-5)
    plain = replace(fast)
    plain.__dict__.update(advance=recursion.advanced, functions=Functions(fast.functions.local, None))
    found = fast.filtered(vector)
    one, other = fast.information(vector, found), plain.information(vector, found)
    assert np.array_equal(plain.filtered(vector).shares, found.shares)
    assert plain.value(vector) == pytest.approx(found.value, rel=1e-10)
    assert np.allclose(one.gradient, other.gradient, rtol=1e-8, atol=1e-9 * np.abs(one.gradient).max())
    assert np.allclose(one.matrix, other.matrix, rtol=1e-8, atol=1e-9 * np.abs(one.matrix).max())


@pytest.mark.parametrize("solver", ["ros34pw2", "dopri5"])
def test_errors_follow_the_tolerance(tmp_path: Path, solver: str) -> None:
    data = table("X V y", rows=8)
    short, vector = engine_of(tmp_path, BENT, data, max_step=0.005)
    expected, errors, steps = short.value(vector), [], []
    for tolerance in (1e-4, 1e-6):
        engine, _ = engine_of(tmp_path, BENT, data, solver=solver, tolerance=tolerance)
        found = engine.filtered(vector)
        errors.append(abs(found.value - expected))
        steps.append(int((found.shares > 0).sum()))
    assert steps[1] > steps[0]
    assert errors[1] < min(errors[0], 1e-2)


def test_a_step_is_divided_only_where_its_error_is_beyond_the_tolerance() -> None:
    shares = np.array([[0.5, 0.5], [1.0, 0.0], [0.25, 0.75]])
    found = refined(shares, np.array([[0.3, 2.0], [0.9, 0.0], [np.inf, 0.1]]))
    assert found[0].tolist() == pytest.approx([0.5, 0.25, 0.25, *[0] * 6])
    assert found[1].tolist() == [1, *[0] * 8]
    assert found[2].tolist() == pytest.approx([0.25 / 8] * 8 + [0.75])
    assert np.allclose(found.sum(axis=1), 1)
    many = np.full((1, MOST), 1 / MOST)
    assert np.array_equal(refined(many, np.full(many.shape, 2.0)), many)
    assert trimmed(joined(shares, np.array([1]), np.full((1, 4), 0.25))).shape == (3, 4)


def test_where_no_steps_suffice_there_is_no_solution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.engines.filter.division.MOST", 3)
    engine, vector = stiff(tmp_path, BENT, table("X V y", rows=8), tolerance=1e-9)
    found = engine.filtered(vector)
    assert not found.finite
    assert found.bad.any()


BUFFERED = """model buffered
time t
input u in [0, 4] held
state x in [0, 8]
state y in [0, 8]
learn k = 0.3 in [0.05, 10]
learn m = 3 in [0.1, 20]
learn s = 1 in [0, 5]
x' = u - k*y
y' = 1e4*(x^2/(m + x) - y)
diffusion x = s
observe x noise normal(0.05)
observe y noise normal(0.05)
"""


def buffered(folder: Path, count: int = 50, step: float = 0.3) -> tuple[Model, Trajectories]:
    """A pool x whose outflow y follows it at once, with k = 1, m = 1 and s = 0.3."""
    rng, x, h = np.random.default_rng(3), 1.5, 1e-3
    lines = ["t,u,x,y"]
    for i in range(count):
        u = (2.0, 0.4)[i // 6 % 2]
        noise = 0.05 * rng.standard_normal(2)
        lines.append(f"{i * step:.1f},{u},{x + noise[0]:.4f},{x * x / (1 + x) + noise[1]:.4f}")
        for _ in range(round(step / h)):
            x += h * (u - x * x / (1 + x)) + 0.3 * np.sqrt(h) * rng.standard_normal()
    (folder / "m.gb").write_text(BUFFERED, encoding="utf-8")
    (folder / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    model = load_model(folder / "m.gb", Findings())
    return model, read(folder / "d.csv", model, Findings())


def test_a_stiff_model_is_fitted_with_the_solver_that_auto_chooses(tmp_path: Path) -> None:
    model, data = buffered(tmp_path)
    run = train(model, data, TrainOptions(effort="low"), tmp_path / "run")
    assert run.fit.solver == "ros34pw2"
    assert "stiff" in (run.fit.solver_reason or "")
    for name, truth in (("k", 1.0), ("m", 1.0), ("s", 0.3)):
        constant = run.fit.constants[name]
        assert constant.sd is not None
        assert abs(constant.value - truth) < 3 * constant.sd < truth / 2, (name, constant)
    # The filter of the finished run takes steps by the same tolerance.
    likelihood = run.fit.members[0].likelihood
    assert likelihood is not None
    assert filter_run(run, data, 0).found.value == pytest.approx((likelihood.minus2ll or 0) / 2, abs=1e-6)
    assert run.tolerance(0) == 1e-5


def test_evaluate_takes_the_stiff_solver_where_explicit_steps_find_no_solution(tmp_path: Path) -> None:
    model, data = buffered(tmp_path, 8)
    found = evaluating.of_model(model, data, {"k": 1.0, "m": 1.0, "s": 0.3})
    assert np.isfinite(found.nllh)
    assert found.accuracy < 1e-3


def test_a_fit_whose_explicit_steps_are_too_long_says_so(tmp_path: Path) -> None:
    model, data = buffered(tmp_path, 12)
    slower = tmp_path / "slower.gb"
    slower.write_text(BUFFERED.replace("1e4*", "33*"), encoding="utf-8")
    model = load_model(slower, Findings())
    run = train(model, data, TrainOptions(effort="low", solver="rk4", max_step=0.1), tmp_path / "run")
    assert "as learned, the equations are stiff" in "".join(run.fit.warnings)
