"""Training as a whole: it learns, keeps bounds, resumes exactly, and says what went wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import gbspec
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import ComputationError, UserError
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from gbspec.training.recipe import planning
from tests import quick
from tests.training.conftest import URP, Recorder, model_of, trajectory, urp_data, urp_rhs

WITH_KERNEL = pytest.mark.usefixtures("quick_fit")


def relative_rhs_error(module: object, data: Trajectories) -> float:
    """Median error of the learned right-hand side at states of the data, relative to its deviation."""
    rows = [(v, item.condition[0]) for item in data.items for v in item.values[3:] if np.isfinite(v).all()]
    x, Da = np.array([v for v, _ in rows]), np.array([c for _, c in rows])
    truth = np.array([urp_rhs(0.0, a, b) for a, b in zip(x, Da, strict=True)])
    with torch.no_grad():
        found = module.rhs(0.0, torch.from_numpy(x), torch.from_numpy(Da[:, None])).numpy()  # type: ignore[attr-defined]
    return float(np.median(np.abs(found - truth) / truth.std(axis=0)))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, kernels: Path) -> Path:
    path = tmp_path_factory.mktemp("fit") / "run"
    with quick.warm_start(250), quick.fits(kernels):
        train(model_of(URP), urp_data(16, 5.0, 2), TrainOptions(effort="low"), path)
    return path


def test_learns_the_reactor(fitted: Path) -> None:
    run = open_run(fitted)
    assert relative_rhs_error(run.member(), urp_data(30, 5.0, 99, together=True)) < 0.01
    constants = run.fit.constants
    assert constants["B"].value == pytest.approx(11, rel=0.05)
    assert constants["beta"].value == pytest.approx(3, rel=0.07)
    assert all(rmse < 0.1 for rmse in run.fit.members[0].rmse.values())


def test_fit_json_has_its_keys_in_order(fitted: Path) -> None:
    fit = json.loads((fitted / "fit.json").read_text())
    expected = ["gbspec", "model", "data", "options", "versions", "constants", "noise", "members", "warnings"]
    assert list(fit) == [*expected, "correlations", "solver", "step_checks", "interface", "scales", "finished", "files"]
    place = ["path", "sha256", "trajectories", "rows", "values", "absolute", "relative"]
    assert list(fit["data"]) == [*place, "conditions", "content"]
    assert list(fit["constants"]["B"]) == ["value", "sd", "interval", "start", "per_member"]
    assert list(fit["members"][0]) == [
        *["seed", "loss", "rmse", "seconds", "stages", "member", "files", "interval_loss", "channels", "freedom"]
    ]
    assert list(fit["members"][0]["channels"]["x1"]) == [
        *("r2", "naive", "predictor", "held", "values", "weight"),
        *("autocorrelation", "pairs"),
    ]
    header, first, *_ = (fitted / "history.csv").read_text().splitlines()
    assert header == "member,stage,iteration,seconds,loss,B,beta"
    assert first.startswith("0,warm start,1,")
    files = {str(p.relative_to(fitted)) for p in fitted.rglob("*") if p.is_file()}
    assert {"model.gb", "model.py", "members/0/weights.safetensors", "members/0/checkpoint.safetensors"} <= files


@WITH_KERNEL
def test_interrupted_and_resumed_ends_with_the_same_numbers(tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(3, 1.0, 4)
    options = TrainOptions(effort="low")
    whole = train(model, data, options, tmp_path / "whole")
    for after in (2, 7):
        path = tmp_path / f"cut{after}"
        recorder = Recorder(interrupt_after=after)
        with pytest.raises(KeyboardInterrupt):
            train(model, data, options, path, recorder)
        assert len(recorder.updates) == after, "the iteration under way ends, no other begins"
        assert open_run(path).member().weights["constants"].shape == (2,), "an interrupted run can be used"
        assert any("interrupted" in warning for warning in open_run(path).fit.warnings)
        resumed = train(model, data, TrainOptions(effort="low", resume=True), path)
        for name, value in whole.member().weights.items():
            assert np.array_equal(resumed.member().weights[name], value), name
        assert not any("interrupted" in warning for warning in open_run(path).fit.warnings)
        losses = [row["loss"] for row in open_run(path).history()]
        assert losses == [row["loss"] for row in open_run(tmp_path / "whole").history()]


@pytest.mark.parametrize("method", ["adam", "lbfgs", "lm", "gradient-matching"])
def test_each_method_resumes_and_improves(method: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if method != "adam":  # which stays with the torch graph
        request.getfixturevalue("quick_fit")
    model, data = model_of(URP), urp_data(4, 1.0, 5)
    options = {"method": method, "epochs": 4, "batch_size": 3}
    recorder = Recorder()
    whole = train(model, data, TrainOptions(**options), tmp_path / "whole", recorder)
    assert math.isfinite(recorder.updates[-1].loss)
    if method != "gradient-matching":
        own = [u.loss for u in recorder.updates if u.stage == method]
        assert len(own) == 4 and own[-1] < own[0]
        with pytest.raises(KeyboardInterrupt):
            train(model, data, TrainOptions(**options), tmp_path / "cut", Recorder(interrupt_after=4))
        resumed = train(model, data, TrainOptions(**options, resume=True), tmp_path / "cut")
        assert np.array_equal(
            resumed.member().weights["network.phi.0.weight"], whole.member().weights["network.phi.0.weight"]
        )


@WITH_KERNEL
@pytest.mark.parametrize(
    "more",
    [
        {"forcing": "autoregressive", "effort": "low"},
        {"forcing": "0.5", "effort": "low"},
        {"random_substeps": True, "method": "lm", "epochs": 3},
        {"holdout": 0.25, "method": "lm", "epochs": 3},
        {"warm_start": False, "method": "adam", "epochs": 5},
        {"ridge": 2.0, "effort": "low"},
    ],
)
def test_options_give_a_finite_fit(more: dict[str, object], tmp_path: Path) -> None:
    run = train(model_of(URP), urp_data(4, 1.0, 6), TrainOptions(**more), tmp_path / "run")  # type: ignore[arg-type]
    assert math.isfinite(run.fit.members[0].loss)
    low, high = 0.0, 50.0
    assert low < run.member().weights["constants"][0] < high


def test_too_much_for_a_jacobian_goes_by_minibatches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.recipe.planning.LARGEST", 1000)
    monkeypatch.setitem(planning.ALONE, "low", 3)  # type: ignore[arg-type]
    recorder = Recorder()
    train(model_of(URP), urp_data(4, 2.0, 6), TrainOptions(effort="low", batch_size=2), tmp_path / "run", recorder)
    assert [u.stage for u in recorder.updates] == ["warm start", "initial states", "adam", "adam", "adam"]


@WITH_KERNEL
def test_members_differ_and_repeat(tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(2, 1.0, 6)
    options = TrainOptions(members=2, seed=3, method="gradient-matching", workers=1)
    first = train(model, data, options, tmp_path / "a")
    second = train(model, data, options, tmp_path / "b")
    a, b = (run.member(0).weights["network.phi.0.weight"] for run in (first, second))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, first.member(1).weights["network.phi.0.weight"])
    assert [m.seed for m in first.fit.members] == [3, 4]
    per_member = first.fit.constants["B"].per_member
    assert first.fit.constants["B"].value == pytest.approx(np.mean(per_member))


@pytest.mark.slow
def test_workers_give_the_same_members_also_where_they_were_interrupted(tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    # Without a warm start, which is cut short in this process but not in the workers.
    more = {"members": 2, "warm_start": False, "method": "lm", "epochs": 2, "threads": 1}
    one = train(model, data, TrainOptions(**more, workers=1), tmp_path / "one")  # type: ignore[arg-type]
    first, second = Recorder(interrupt_after=1), Recorder()
    with pytest.raises(KeyboardInterrupt):
        train(model, data, TrainOptions(**more, workers=2), tmp_path / "two", first)  # type: ignore[arg-type]
    two = train(model, data, TrainOptions(**more, workers=2, resume=True), tmp_path / "two", second)  # type: ignore[arg-type]
    for k in range(2):
        for name, value in one.member(k).weights.items():
            assert np.allclose(two.member(k).weights[name], value, rtol=1e-9, atol=1e-12), name
    assert {u.member for u in [*first.updates, *second.updates]} == {0, 1}


def test_a_blow_up_says_where_and_what_to_do(tmp_path: Path) -> None:
    text = """model runaway
state x = 1
learn k = 60 in [50, 100]
x' = k*x^2
initial x = 1
observe x
"""
    times = np.linspace(0.1, 2, 5)
    data = Trajectories((trajectory("batch 7", 0.0, times, np.ones((5, 1)), []),), ("x",))
    with pytest.raises(ComputationError) as caught:
        train(model_of(text), data, TrainOptions(), tmp_path / "run")
    assert "`x'`" in caught.value.what
    assert "`batch 7`" in caught.value.where and "t = " in caught.value.where
    assert "--max-step" in caught.value.remedy


def test_refuses_what_makes_no_sense(tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    with pytest.raises(UserError) as caught:
        train(model, data, TrainOptions(members=0, holdout=1.5, forcing="often"), tmp_path / "run")
    assert [d.code for d in caught.value.diagnostics] == ["GB850"] * 3
    with pytest.raises(UserError, match="GB856"):
        train(model, Trajectories((), ("x1", "x2")), TrainOptions(), tmp_path / "run")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    with pytest.raises(UserError, match=r"GB855.*thesis\.tex"):
        train(model, data, TrainOptions(), tmp_path / "full")


def test_refuses_to_resume_with_other_data_or_options(fitted: Path) -> None:
    model = model_of(URP)
    with pytest.raises(UserError, match="already contains a run"):
        train(model, urp_data(16, 5.0, 2), TrainOptions(effort="low"), fitted)
    with pytest.raises(UserError, match="other data"):
        train(model, urp_data(16, 5.0, 3), TrainOptions(effort="low", resume=True), fitted)
    with pytest.raises(UserError, match="--effort low"):
        train(model, urp_data(16, 5.0, 2), TrainOptions(effort="high", resume=True), fitted)
    with pytest.raises(UserError, match="another model"):
        train(model_of(URP.replace("B = 5", "B = 6")), urp_data(16, 5.0, 2), TrainOptions(resume=True), fitted)


@WITH_KERNEL
def test_a_run_solves_with_the_step_that_it_was_fitted_with_last(tmp_path: Path) -> None:
    """After the stage at half the step the weights are those of half the step: no warning of the whole one."""
    (tmp_path / "m.gb").write_text(
        "model m\nstate N in [0, 2]\nunknown rate(N) by mlp(4)\nN' = -rate(N)\nobserve N\ntruth rate(N) = 0.9*N^2\n"
    )
    model = gbspec.load(tmp_path / "m.gb")
    data = model.simulate(trajectories=4, span=2, dt=0.25, keep_start=True, initial={"N": (0.5, 2)}, seed=1)
    for half_step, step in ((True, 0.1), (False, 0.2)):
        run = model.train(data, tmp_path / f"{half_step}", max_step=0.2, half_step=half_step, threads=1, workers=1).run
        assert run.step(0) == step
        stages = [stage.name for stage in run.fit.members[0].stages]
        assert ("half step" in stages) is half_step


def test_an_unknown_that_cancels_out_leaves_the_rest_to_be_learned(tmp_path: Path) -> None:
    declared = "state x in [0, 2] = 1\nlearn k = 2 in [0.1, 3]\nunknown f(x) by mlp(4)\n"
    text = f"model gone\n{declared}x' = -k*x + 0*f\nobserve x\n"
    items = [trajectory(str(a), 0.0, [0.0, 1.0, 2.0], [[a * math.exp(-t)] for t in range(3)], []) for a in (1.0, 1.5)]
    data = Trajectories(tuple(items), ("x",), "made.csv", f"{0:064x}")
    run = train(model_of(text), data, TrainOptions(effort="low", workers=1), tmp_path / "run")
    assert run.fit.constants["k"].value == pytest.approx(1.0, abs=0.02)
