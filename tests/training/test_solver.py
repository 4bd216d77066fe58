"""`--solver`: the method that a run is trained with is recorded, and used by whatever opens the run."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.validation import step_check
from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings, UserError
from gbspec.ir.methods import METHODS, RK4, Explicit
from gbspec.operations import analysing, fitting, models
from gbspec.report.text import run_summary
from gbspec.runs import Run, open_run
from gbspec.training import TrainOptions, train
from gbspec.training.profile import likelihood
from gbspec.training.recipe.stiffness import chosen_solver
from gbspec.training.runs.variations import points
from gbspec.training.starts import Search
from tests.algebraic.models import built
from tests.training.conftest import Recorder, model_of, trajectory, urp_data

KNOWN = """model known_urp
state x1 in [0, 1]
state x2
condition Da in [0.2, 0.5]
learn B = 8 in [0, 50]
learn beta = 2 in [0, 10]
x1' = -x1 + Da*(1 - x1)*exp(x2)
x2' = -x2 + B*Da*(1 - x1)*exp(x2) - beta*x2
observe x1
observe x2
truth B = 11
truth beta = 3
"""
FAST = """model fast
time t from 0
state x in [0, 1] = 1
state y in [0, 1] = 0.3
learn k = 1 in [0.01, 10]
learn c = 0.5 in [0.01, 10]
x' = -k*x
y' = 5000*(c*x - y)
observe x
observe y
"""
HEUN = Explicit(
    "heun",
    3,
    a=((), (Fraction(1, 3),), (Fraction(0), Fraction(2, 3))),
    b=(Fraction(1, 4), Fraction(0), Fraction(3, 4)),
    source="Heun (1900), Z. Math. Phys. 45, 23",
    help="Heun's, of order 3",
)

pytestmark = pytest.mark.usefixtures("quick_fits", "few_points")

QUICK = {"max_step": 0.25, "method": "lm", "epochs": 6, "workers": 1}


def trained(solver: str, path: Path, **more: object) -> Run:
    options = TrainOptions(solver=solver, **QUICK, **more)  # type: ignore[arg-type]
    return train(model_of(KNOWN), urp_data(3, 2.0, 5), options, path)


@pytest.fixture
def heun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METHODS, "heun", HEUN)


@pytest.mark.usefixtures("heun")
def test_a_method_that_was_just_entered_runs_through_training(tmp_path: Path) -> None:
    made = trained("heun", tmp_path / "run")
    fit = json.loads((tmp_path / "run" / "fit.json").read_text())
    assert fit["solver"] == fit["options"]["solver"] == "heun"
    assert 'solver: ClassVar[str] = "heun"' in (tmp_path / "run" / "model.py").read_text()
    opened = open_run(tmp_path / "run")
    assert opened.method is HEUN and opened.member().info["solver"] == "heun"
    assert opened.module is made.module and opened.module.solver == "heun"
    # Its own error, of the third order at this step, is in the constants; a step of the fifth has next to none.
    exact = trained("dopri5", tmp_path / "exact")

    def off(run: Run) -> float:
        return max(abs(run.fit.constants[name].value / true - 1) for name, true in (("B", 11), ("beta", 3)))

    assert 5 * off(exact) < off(opened) < 0.1


def test_the_backends_train_alike(tmp_path: Path) -> None:
    graph, kernel = (trained("dopri5", tmp_path / name, backend=name) for name in ("torch", "native"))
    for name, entry in graph.fit.constants.items():
        assert kernel.fit.constants[name].value == pytest.approx(entry.value, rel=1e-9)


def test_whatever_opens_a_run_steps_as_it_was_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, data = trained("rk38", tmp_path / "run"), urp_data(3, 2.0, 5)
    seen: list[str] = []
    fixed = step_check._fixed

    def spied(evaluator: object, *rest: object) -> object:
        seen.append(evaluator.instance.solver)  # type: ignore[attr-defined]
        return fixed(evaluator, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(step_check, "_fixed", spied)
    checked = fitting.with_step_checks(run, data, TrainOptions())
    assert analysing.validate(open_run(tmp_path / "run"), data).step_check.half_step is not None
    assert set(seen) == {"rk38"} and len(checked.fit.step_checks) == 1
    profiler = likelihood._Profiler(open_run(tmp_path / "run"), "B", data, 0, 1)
    assert profiler.free.method.name == "rk38" and profiler.free.packed().nodes == (0.0, 1 / 3, 2 / 3, 1.0)
    assert models.learned(open_run(tmp_path / "run")).evaluator.instance.solver == "rk38"


def test_a_run_is_resumed_with_its_method_alone(tmp_path: Path) -> None:
    model, data = model_of(KNOWN), urp_data(3, 2.0, 5)
    whole = trained("dopri5", tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(model, data, TrainOptions(solver="dopri5", **QUICK), tmp_path / "run", Recorder(3))  # type: ignore[arg-type]
    with pytest.raises(UserError) as caught:
        train(model, data, TrainOptions(solver="rk4", resume=True, **QUICK), tmp_path / "run")  # type: ignore[arg-type]
    assert "`--solver dopri5`, not rk4" in caught.value.diagnostics[0].message
    # A solver that is left to the training is the one that the run was begun with.
    again = train(model, data, TrainOptions(resume=True, **QUICK), tmp_path / "run")  # type: ignore[arg-type]
    assert again.fit.solver == again.module.solver == "dopri5"
    assert np.array_equal(again.member().weights["constants"], whole.member().weights["constants"])


def test_a_run_from_before_there_was_a_choice_is_of_the_classical_method(tmp_path: Path) -> None:
    run = trained("rk4", tmp_path / "run")
    path = tmp_path / "run" / "fit.json"
    fit = json.loads(path.read_text())
    del fit["solver"], fit["options"]["solver"]
    path.write_text(json.dumps(fit))
    old = open_run(tmp_path / "run")
    assert old.method is RK4 and old.module is run.module
    again = trained("rk4", tmp_path / "run", resume=True)
    assert np.array_equal(again.member().weights["constants"], run.member().weights["constants"])


@pytest.mark.parametrize("solver", ["ros34pw", ["rk4"], None])
def test_a_run_of_a_method_that_this_version_does_not_have(tmp_path: Path, solver: object) -> None:
    trained("rk4", tmp_path / "run")
    path = tmp_path / "run" / "fit.json"
    path.write_text(path.read_text().replace('"solver": "rk4"', f'"solver": {json.dumps(solver)}'))
    with pytest.raises(UserError) as caught:
        open_run(tmp_path / "run")
    assert {diagnostic.code for diagnostic in caught.value.diagnostics} == {"GB852"}
    diagnostic = caught.value.diagnostics[-1]
    if isinstance(solver, str):
        assert f"`{solver}`" in diagnostic.message
        assert diagnostic.help is not None and ", ".join(METHODS) in diagnostic.help
    else:
        assert "`solver` is" in diagnostic.message and "expected a text" in diagnostic.message


def test_a_wrong_name_is_told_with_the_right_ones(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        trained("euler", tmp_path / "run")
    (diagnostic,) = caught.value.diagnostics
    assert diagnostic.code == "GB850" and diagnostic.subject == "solver"
    assert diagnostic.message.startswith("`--solver euler` must be one of `rk4`, `rk38`, `dopri5`")
    assert not (tmp_path / "run").exists()


# ------------------------------------------------------------------------------------------------ auto
def test_equations_that_are_not_stiff_keep_the_classical_method(tmp_path: Path) -> None:
    chosen, named = (trained(solver, tmp_path / solver) for solver in ("auto", "rk4"))
    assert chosen.fit.solver == "rk4" and chosen.fit.solver_reason is None
    assert chosen.fit.options["solver"] == "auto"
    assert np.array_equal(chosen.member().weights["constants"], named.member().weights["constants"])


def test_stiff_equations_get_the_stiff_method_and_a_reason(tmp_path: Path) -> None:
    """A fast decay (rate 5000) that the starting values of the constants show; the data are spaced by 0.2."""
    model = model_of(FAST)
    times = np.linspace(0.0, 4.0, 21)
    values = np.stack([np.exp(-0.5 * times), 0.3 * np.exp(-0.5 * times)], 1)
    data = Trajectories((trajectory("0", 0.0, times, values, []),), ("x", "y"))
    seen = Recorder()
    made = train(model, data, TrainOptions(method="lm", epochs=8, workers=1), tmp_path / "run", seen)
    assert made.fit.solver == made.module.solver == "ros34pw2" and made.fit.options["solver"] == "auto"
    assert made.fit.solver_reason is not None and made.fit.solver_reason.startswith("the equations are stiff")
    assert f"solver `ros34pw2`: {made.fit.solver_reason}" in run_summary(made)
    assert any("the solver is `ros34pw2`: the equations are stiff" in text for text in seen.messages)
    assert made.member().info["tolerance"] == 1e-5 and made.member().info["max_step"] is None
    assert made.fit.constants["k"].value == pytest.approx(0.5, rel=1e-4)
    assert made.fit.constants["c"].value == pytest.approx(0.3, rel=1e-3)
    opened = open_run(tmp_path / "run")
    states = opened.member().simulate([1.0, 0.3], times).detach().numpy()
    assert np.abs(states - values).max() < 1e-3, "steps are adaptive there too"
    assert not opened.fit.step_checks and analysing.validate(opened, data).step_check.half_step is None


@pytest.mark.parametrize("rate", [5000, 1])
def test_the_reduced_equations_of_algebraic_variables_are_looked_at(rate: int) -> None:
    """y follows z, which an equation gives: the decay is that of the balance in which z has been eliminated."""
    text = FAST.replace("learn k", "algebraic z in [0, 1] = 0.5\nlearn k").replace(
        "y' = 5000*(c*x - y)", f"y' = {rate}*(z - 0.5*y)\nequation follow: z + 0.1*z^3 = c*x - 0.5*y"
    )
    model, times = built(text), np.linspace(0.0, 4.0, 21)
    values = np.stack([np.exp(-0.5 * times), 0.25 * np.exp(-0.5 * times)], 1)
    data = Trajectories((trajectory("0", 0.0, times, values, []),), ("x", "y"))
    name, reason = chosen_solver(model, load_module(model), data, TrainOptions(backend="torch"))
    assert name == ("ros34pw2" if rate > 1 else "rk4")
    assert (reason is not None and reason.startswith("the equations are stiff")) == (rate > 1)


def test_times_over_many_decades_get_the_stiff_method() -> None:
    model, options = model_of(FAST), TrainOptions()
    times = np.logspace(-5, 5, 30)
    values = np.stack([np.exp(-0.5 * times), 0.3 * np.exp(-0.5 * times)], 1)
    data = Trajectories((trajectory("0", 0.0, times, values, []),), ("x", "y"))
    name, reason = chosen_solver(model, load_module(model), data, options)
    assert name == "ros34pw2" and reason is not None and "spread over several decades" in reason


@pytest.mark.parametrize(("stiff", "expected"), [(0.2, "ros34pw2"), (0.95, "rk4")])
def test_draws_that_only_the_stiff_method_solves_count_where_they_are_better(
    stiff: float, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The warm start shows nothing; of the draws the explicit method solves one, with a loss of 1."""

    def losses(search: Search, theta: Array) -> tuple[Array, Array]:
        explicit = search.engine.problem.control is None
        return np.zeros((3, 1)), np.array([np.inf, 1.0, np.nan]) if explicit else np.array([stiff, 1.0, np.nan])

    monkeypatch.setattr(Search, "losses", losses)
    model = model_of(KNOWN)
    name, reason = chosen_solver(model, load_module(model), urp_data(3, 2.0, 5), TrainOptions(backend="torch"))
    assert name == expected
    assert (reason is not None) == (expected == "ros34pw2")
    assert reason is None or "2 cannot be solved with `rk4`" in reason


@pytest.mark.parametrize(("solved", "expected"), [(3, "ros34pw2"), (2, "rk4")])
def test_draws_that_mostly_the_stiff_method_alone_solves_count_however_near_the_best_is(
    solved: int, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of five draws the explicit method solves one, which is the best one."""

    def losses(search: Search, theta: Array) -> tuple[Array, Array]:
        found = np.array([1.0, *[np.inf] * 4])
        if search.engine.problem.control is not None:
            found[1 : 1 + solved] = 2.0
        return np.zeros((5, 1)), found

    monkeypatch.setattr(Search, "losses", losses)
    model = model_of(KNOWN)
    name, reason = chosen_solver(model, load_module(model), urp_data(3, 2.0, 5), TrainOptions(backend="torch"))
    assert name == expected
    assert reason is None or ("of 5 points" in reason and "3 can be solved with `ros34pw2` alone" in reason)


def test_a_tolerance_makes_the_steps_of_an_explicit_method_adaptive(tmp_path: Path) -> None:
    made = trained("auto", tmp_path / "run", tolerance=1e-5)
    assert made.fit.solver == "dopri5" and made.member().info["tolerance"] == 1e-5
    for name, true in (("B", 11), ("beta", 3)):
        assert made.fit.constants[name].value == pytest.approx(true, rel=2e-3)
    with pytest.raises(UserError) as caught:
        trained("rk4", tmp_path / "other", tolerance=1e-5)
    (diagnostic,) = caught.value.diagnostics
    assert diagnostic.code == "GB850" and "which has no error estimate" in diagnostic.message


def test_fingerprints_from_before_there_was_a_choice_are_met() -> None:
    assert "solver" not in TrainOptions().settings(())
    assert TrainOptions(solver="dopri5").settings(("seed",))["solver"] == "dopri5"
    assert "seed" not in TrainOptions().settings(("seed",)) and "effort" in TrainOptions().settings(())


def test_sweeps_vary_it() -> None:
    findings = Findings()
    made = points(["solver=rk4,dopri5"], TrainOptions(), findings)
    assert [point.options.solver for point in made] == ["rk4", "dopri5"] and not len(findings)
    points(["solver=rk5"], TrainOptions(), findings)
    assert [diagnostic.code for diagnostic in findings] == ["GB850"]
