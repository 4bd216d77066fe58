"""Censored values contribute their probability: the same in every engine, with exact derivatives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import norm

from gbspec.analysis import validate
from gbspec.data import Trajectories, to_arrays
from gbspec.data.keeping import from_arrays
from gbspec.data.table import read_frame
from gbspec.diagnostics import Findings, UserError
from gbspec.ir.censoring import Censored
from gbspec.ir.model import Model
from gbspec.ir.residual import residuals, slopes
from gbspec.report.collect import Fitted, trajectory_fits
from gbspec.report.description import Axis, Points
from gbspec.report.figures.fit import panel
from gbspec.report.text import run_summary
from gbspec.training import TrainOptions, train
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.objective import half_squares, residual_table
from gbspec.training.recipe import check_limits
from gbspec.training.starts.initial_states import first_rows
from tests.training.conftest import model_of, problem_of
from tests.training.reference import linearise, measured_residuals, unroll, whole_jacobian

DECAY = """model decay
time t from 0
state x in [0, 3]
learn k = 0.7 in [0.01, 5]
x' = -k*x
initial x = 2
observe x noise normal(0.1)
"""
LIMITED = {"t": [0.5, 1.0, 2.0, 4.0, 6.0], "x": ["1.5", ">0.9", "0.6", "<0.2", "<0.2"]}


def data_of(model: Model) -> Trajectories:
    return read_frame(LIMITED, model, Findings())


def test_half_the_square_is_minus_the_logarithm_of_the_probability() -> None:
    predicted, limit, sd = np.array([-3.0, 0.1, 0.2, 0.3, 9.0]), 0.2, 0.1
    for side, probability in ((-1, norm.logcdf((limit - predicted) / sd)), (1, norm.logsf((limit - predicted) / sd))):
        given = Censored(np.full(5, side, dtype=np.int8), np.ones(1))
        found = residuals(predicted, limit, np.full(5, 1 / sd), np.zeros(5, dtype=bool), censored=given)
        assert np.allclose(0.5 * found**2, -probability, rtol=1e-9, atol=1e-290)


@pytest.mark.parametrize("level", [0.0, 0.3])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_slopes_are_derivatives_by_numpy_and_torch(level: float, logarithmic: bool) -> None:
    predicted = np.linspace(0.02, 4, 40)[:, None] * np.ones(2)
    limit, factor = np.ones((40, 2)), np.full((40, 2), 3.0)
    side = np.tile(np.array([-1, 1], dtype=np.int8), (40, 1))
    given, logs = Censored(side, np.array([level, level])), np.array([logarithmic] * 2)
    h = 1e-6
    ahead, behind = (residuals(predicted + s * h, limit, factor, logs, censored=given) for s in (1, -1))
    found = slopes(predicted, limit, factor, logs, censored=given)
    assert np.allclose(found, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6)
    x = torch.from_numpy(predicted).requires_grad_()
    tables = torch.from_numpy(limit), torch.from_numpy(factor)
    by_torch = residuals(x, *tables, logs, torch, given)
    assert np.allclose(by_torch.detach().numpy(), residuals(predicted, limit, factor, logs, censored=given))
    (gradient,) = torch.autograd.grad(by_torch.sum(), x)
    assert np.allclose(gradient.numpy(), found, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("noise", ["noise normal(0.1)", "noise lognormal(0.2)", ""])
def test_engines_agree_and_the_jacobian_is_exact(noise: str) -> None:
    model = model_of(DECAY.replace("noise normal(0.1)", noise))
    problem, parameters, theta = problem_of(model, data_of(model), 0.1, blend=1.0)
    first, second = torch_engine(problem, parameters), native_engine(problem, parameters)
    assert np.allclose(residual_table(first, theta), residual_table(second, theta), rtol=1e-10, atol=1e-12)
    (a, da), (b, db) = half_squares(first, theta), half_squares(second, theta)
    assert a == pytest.approx(b, rel=1e-10) and np.allclose(da, db, rtol=1e-9)
    found = whole_jacobian(linearise(problem, parameters, theta), parameters)
    expected = torch.autograd.functional.jacobian(
        lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals), torch.from_numpy(theta)
    )
    assert float((found - expected).abs().max()) < 1e-9 * float(expected.abs().max())
    assert (problem.forcing.weight[:, 0] > 0).tolist() == [True, False, True, False, False]  # limits never reset


def test_a_fit_maximises_the_likelihood(tmp_path: Path, quick_fit: None) -> None:
    model = model_of(DECAY)
    made = train(model, data_of(model), TrainOptions(effort="low"), tmp_path / "run")

    def minus(k: float) -> float:
        x = 2 * np.exp(-k * np.array(LIMITED["t"], dtype=float))
        known = norm.logpdf([1.5, 0.6], x[[0, 2]], 0.1).sum()
        return -float(known + norm.logcdf(0.2, x[3:], 0.1).sum() + norm.logsf(0.9, x[1], 0.1))

    best = minimize(lambda v: minus(float(v[0])), [0.6], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-13})
    assert made.fit.constants["k"].value == pytest.approx(float(best.x[0]), rel=1e-5)
    channel = (made.fit.members[0].channels or {})["x"]
    assert (channel.values, channel.censored, channel.averages) == (5, 3, None)
    assert "5 (3 censored)" in run_summary(made)
    judged = validate(made, data_of(model))
    assert judged.limits["x"].n == 3 and judged.channels["x"].n == 2
    assert "3 of 3 censored values" in str(judged) or "others by" in str(judged)
    assert judged.to_json()["limits"] == {"x": judged.limits["x"].to_json()}
    (shown,) = trajectory_fits(Fitted(made, data_of(model)), [0])
    assert shown.channels[0].below is not None and shown.channels[0].above is not None
    assert shown.channels[0].below.tolist() == [[4, 6], [0.2, 0.2]] and shown.channels[0].above.tolist() == [[1], [0.9]]
    labels = [mark.label for mark in panel(shown.channels[0], Axis("t")).marks if isinstance(mark, Points)]
    assert labels[-3:] == ["below", "above", "measured"] or set(labels) >= {"below", "above"}


def test_an_unstated_noise_is_pointed_out() -> None:
    model = model_of(DECAY.replace("noise normal(0.1)", ""))
    (remark,) = check_limits(model, data_of(model))
    assert "state it" in remark and "`x`" in remark
    assert check_limits(model_of(DECAY), data_of(model)) == []


def test_limits_are_read_kept_and_written() -> None:
    model = model_of(DECAY)
    data = data_of(model)
    limits = data.items[0].censored
    assert limits.side.ravel().tolist() == [0, 1, 0, -1, -1]
    assert np.array_equal(limits.value.ravel(), [np.nan, 0.9, np.nan, 0.2, 0.2], equal_nan=True)
    assert data.measurements == 5
    frame = data.to_frame()
    assert frame["x"].to_list() == [1.5, 0.9, 0.6, 0.2, 0.2]
    assert frame["limit_x"].to_list() == [None, 1, None, -1, -1]
    again = read_frame(frame, model, Findings())
    arrays, texts = to_arrays(data)
    kept = from_arrays(arrays, texts["labels"], texts["channels"], 0, 0)  # type: ignore[arg-type]  # lists of texts
    for other in (again, kept):
        assert np.array_equal(other.items[0].censored.side, limits.side)
    long = {"t": [1.0, 2.0], "name": ["x", "x"], "value": ["1.2", "<= 0.5"]}
    assert read_frame(long, model, Findings()).items[0].censored.side.ravel().tolist() == [0, -1]


def test_limits_with_disturbances_are_refused(tmp_path: Path) -> None:
    model = model_of(DECAY.replace("initial", "diffusion x = 0.1\ninitial"))
    with pytest.raises(UserError) as caught:
        train(model, data_of(model), TrainOptions(), tmp_path / "run")
    assert [d.code for d in caught.value.diagnostics] == ["GB784"]


def test_limits_stay_with_their_rows() -> None:
    """Parts of a problem have the limits of their rows, and no others."""
    model = model_of(DECAY)
    table = {"trajectory": [1, 1, 1, 2, 2], "t": [0.5, 1, 2, 1, 3], "x": ["1", "<0.9", "0.6", ">0.8", "0.4"]}
    problem, _, _ = problem_of(model, read_frame(table, model, Findings()), 0.5)
    for part in (first_rows(problem, 2), problem.take([1, 0]), problem.take([1])):
        assert part.seen.shape == part.packed.limits.side.shape == part.measured.shape
        known = part.packed.limits.side == 0
        assert np.array_equal(np.isfinite(part.packed.values), known)


def test_noise_terms_are_those_of_the_maximum_of_the_likelihood() -> None:
    """Tobin's estimate of the noise, half of the values censored: unbiased, where each limit as a value is not."""
    rng, sd = np.random.default_rng(0), 0.3
    values = rng.normal(size=(40_000, 1)) * sd
    side = np.where(values < 0.1, -1, 0).astype(np.int8)
    measured = np.where(side == 0, values, 0.1)
    given, seen = Censored(side, np.full(1, sd)), np.ones_like(values, dtype=bool)
    found = residuals(np.zeros_like(values), measured, np.ones((1, 1)), np.zeros(1, dtype=bool), censored=given)
    squares, counts = given.noise_terms(found[seen], seen)
    assert np.sqrt(squares.sum() / counts.sum()) == pytest.approx(sd, rel=0.02)
    violated = Censored(np.full((2, 1), -1, dtype=np.int8), np.full(1, sd))
    squares, counts = violated.noise_terms(np.array([0.0, 5.0]), np.ones((2, 1), dtype=bool))
    assert squares == pytest.approx([0.0, 25.0], rel=0.05) and counts == pytest.approx([0.0, 0.0])


def test_values_far_below_their_limit_say_nothing_of_the_noise(tmp_path: Path) -> None:
    """Intervals are those of the table without these cells: each counted as a value, and they were far too narrow."""
    model, rng = model_of(DECAY.replace(" noise normal(0.1)", " noise lognormal(0.1)")), np.random.default_rng(1)
    times = np.arange(0.2, 2.6, 0.2)
    values = [f"{v:.4f}" for v in 2 * np.exp(-0.7 * times) * np.exp(0.1 * rng.normal(size=len(times)))]
    late = np.arange(8.0, 14.0, 0.2)
    limits = ["<0.3"] * len(late)
    found = []
    for more, cells in ((late, limits), (late[:0], [])):
        table = {"t": [*times.tolist(), *more.tolist()], "x": [*values, *cells]}
        data = read_frame(table, model, Findings())
        found.append(train(model, data, TrainOptions(threads=1), tmp_path / str(len(more))).fit.constants["k"])
    assert found[0].value == pytest.approx(found[1].value, rel=1e-3)
    assert found[0].sd == pytest.approx(found[1].sd, rel=0.05)
