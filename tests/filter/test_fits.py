"""Fits, validations, predictions and simulations of models with random disturbances."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from gbspec.backends import Evaluator
from gbspec.data import SimulateOptions, Trajectories, read
from gbspec.diagnostics import Findings, UserError
from gbspec.frontend import load_model
from gbspec.ir import Model
from gbspec.operations import analysing, comparing, fitting, models
from gbspec.report.text import run_summary
from gbspec.runs import Covariance, Run, files, open_run
from gbspec.training import TrainOptions, filter_run, stages, train
from gbspec.training.engines import whiteness
from gbspec.training.runs.filtering import FilteredRun, RowMoments

PROCESS = """model process
time t
state X in [-5, 5] = 0
learn theta = 0.5 in [0.01, 10]
learn mu = 0.5 in [-5, 5]
learn s = 0.3 in [0, 5]
X' = theta*(mu - X)
diffusion X = s
observe X
truth theta = 1
truth mu = 1
truth s = 0.5
"""
FAST = TrainOptions(effort="low", backend="torch", device="cpu")


def model_in(folder: Path, text: str) -> Model:
    path = folder / "m.gb"
    path.write_text(text, encoding="utf-8")
    return load_model(path, Findings())


def data_in(folder: Path, model: Model, rows: int = 120, noise: float = 0.1) -> Trajectories:
    rng, x, step = np.random.default_rng(3), 1.0, 0.2
    a = np.exp(-step)
    lines = ["t,X"]
    for k in range(rows):
        lines.append(f"{k * step:.2f},{x + noise * rng.standard_normal():.6f}")
        x = 1 + a * (x - 1) + 0.5 * np.sqrt((1 - a * a) / 2) * rng.standard_normal()
    path = folder / "d.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return read(path, model, Findings())


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Trajectories]:
    folder = tmp_path_factory.mktemp("process")
    model = model_in(folder, PROCESS)
    data = data_in(folder, model)
    return train(model, data, FAST, folder / "run"), data


def test_drift_disturbance_and_noise_are_found_with_intervals(fitted: tuple[Run, Trajectories]) -> None:
    run, _ = fitted
    found = run.fit.constants
    for name, true in (("theta", 1.0), ("mu", 1.0), ("s", 0.5)):
        sd = found[name].sd
        assert sd is not None
        assert abs(found[name].value - true) < 3.5 * sd
    likelihood = run.fit.members[0].likelihood
    assert likelihood is not None
    assert likelihood.minus2ll is not None
    assert likelihood.least is not None and likelihood.least <= likelihood.minus2ll
    assert likelihood.aic == pytest.approx(likelihood.least + 2 * 4)
    interval = likelihood.noise["X"].interval
    assert interval is not None
    assert interval[0] < 0.1 < interval[1]
    assert run.fit.objective is not None
    assert likelihood.whiteness["X"].values == 120


def test_the_last_iteration_below_the_maximum_is_no_fit(
    fitted: tuple[Run, Trajectories], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = cast(dict[str, tuple[int, int, int]], stages._MOST)
    monkeypatch.setitem(most, stages.StageName.INNOVATIONS, (2, 2, 2))
    run = train(fitted[0].model, fitted[1], FAST, tmp_path / "run")
    (told,) = [one for one in run.fit.warnings if "ended early" in one]
    assert "the stage `innovations` ended early: -2 log likelihood is still falling in iteration 2, the last" in told
    assert "It is no fit" in told and "`--effort high`" in told
    assert all(one.sd is None for one in run.fit.constants.values())
    found = run.fit.members[0].likelihood
    assert found is not None and found.maximum is False and (found.least, found.aic, found.bic) == (None,) * 3
    assert all(one.interval is None for one in found.noise.values())
    assert run.certainties(0).covariance is None and "innovations; not at its maximum" in run_summary(
        open_run(run.path)
    )
    with pytest.raises(UserError, match="GB775"):
        comparing.compare([fitted[0], run])
    assert not any("ended early" in one for one in fitted[0].fit.warnings)


class Stop:
    """Interrupts the fourth iteration."""

    def __init__(self) -> None:
        self.count = 0

    def update(self, update: object) -> None:
        self.count += 1
        if self.count == 4:
            raise KeyboardInterrupt

    def message(self, text: str) -> None:
        pass


def test_the_same_seed_gives_the_same_fit_and_an_interrupted_one_goes_on(
    fitted: tuple[Run, Trajectories], tmp_path: Path
) -> None:
    run, data = fitted
    with pytest.raises(KeyboardInterrupt):
        train(run.model, data, FAST, tmp_path / "again", Stop())

    resumed = train(run.model, data, replace(FAST, resume=True), tmp_path / "again")
    assert {k: v.value for k, v in resumed.fit.constants.items()} == {k: v.value for k, v in run.fit.constants.items()}


def test_a_stage_of_an_earlier_edition_begins_again_where_it_was(
    fitted: tuple[Run, Trajectories], tmp_path: Path
) -> None:
    run, data = fitted
    with pytest.raises(KeyboardInterrupt):
        train(run.model, data, FAST, tmp_path / "again", Stop())
    path = tmp_path / "again" / "members" / "0" / "checkpoint.safetensors"
    arrays, remarks = files.read_tensors(path)
    for name in ("edition", "state.slope", "state.pinned"):
        del arrays[name]
    files.write_tensors(path, arrays, remarks)
    resumed = train(run.model, data, replace(FAST, resume=True), tmp_path / "again")
    for name in ("theta", "mu", "s"):
        assert resumed.fit.constants[name].value == pytest.approx(run.fit.constants[name].value, rel=1e-2)


def test_validation_has_errors_one_ten_and_all_rows_ahead(fitted: tuple[Run, Trajectories]) -> None:
    run, data = fitted
    found = analysing.validate(run, data, 0)
    assert list(found.ahead) == ["1", "10", "all"]
    one, ten, whole = (found.ahead[name]["X"] for name in ("1", "10", "all"))
    assert one.rmse < ten.rmse
    assert whole.rmse == pytest.approx(found.channels["X"].rmse, rel=1e-3)
    assert "rows ahead" in str(found)
    assert "10" in json.loads(json.dumps(found.to_json()))["ahead"]


def test_predictions_are_smoothed_states_with_bands_that_widen_after_the_window(
    fitted: tuple[Run, Trajectories],
) -> None:
    run, data = fitted
    given = replace(run, values={name: one.value for name, one in run.fit.constants.items()})
    open_ones, known = (analysing.predict(one, data, window=60) for one in (run, given))
    assert (open_ones.items[0].sd > known.items[0].sd).all()
    frame = known.to_frame()
    width = (frame["X_high"] - frame["X_low"]).to_numpy()
    assert frame["used"][:60].unique().to_list() == ["window"]
    assert width[60:].min() > width[5:55].max()
    # Far ahead the band of given constants is that of the stationary distribution and the noise.
    constants = run.fit.constants
    noise = run.fit.noise["X"] or 0.0
    sd = np.sqrt(constants["s"].value ** 2 / (2 * constants["theta"].value) + noise**2)
    assert width[-1] == pytest.approx(2 * 1.645 * sd, rel=1e-2)


@pytest.mark.parametrize("window", [None, 500])
def test_rows_after_the_last_measured_one_are_predicted(fitted: tuple[Run, Trajectories], window: int | None) -> None:
    run, data = fitted
    (item,) = data.items
    values = item.values.copy()
    values[50], values[110:] = np.nan, np.nan
    (shown,) = analysing.predict(run, replace(data, items=(replace(item, values=values),)), window=window).items
    assert shown.used == ("window",) * 110 + ("predicted",) * (len(values) - 110)


def test_predictions_without_a_number_are_told(
    fitted: tuple[Run, Trajectories], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, data = fitted
    item, smoothed = data.items[0], FilteredRun.smoothed_after

    def broken(self: FilteredRun, training: Covariance) -> list[RowMoments]:
        *rest, last = smoothed(self, training)
        return [*rest, replace(last, channels=np.full_like(last.channels, np.nan))]

    monkeypatch.setattr(FilteredRun, "smoothed_after", broken)
    found = analysing.predict(run, replace(data, items=(item, replace(item, label="lost"))))
    assert found.items[1].failure and not found.items[0].failure
    assert any("`lost` could not be predicted" in text for text in found.warnings)
    assert "shown by all measurements" in str(found)


def test_what_is_hidden_is_not_used(fitted: tuple[Run, Trajectories]) -> None:
    run, data = fitted
    hidden, found = np.zeros(len(data.items[0].times), dtype=bool), []
    hidden[:6] = hidden[40:50] = True
    for number in (99.0, 55.0):
        values = np.where(hidden[:, None], number, data.items[0].values)
        changed = replace(data, items=(replace(data.items[0], values=values),))
        found.append(filter_run(run, changed, 0, hidden=[hidden]).smoothed(draws=4)[0])
    assert np.allclose(found[0].channels, found[1].channels, rtol=1e-9)
    assert np.allclose(found[0].channel_sd, found[1].channel_sd, rtol=1e-9)
    plain = filter_run(run, changed, 0, hidden=[hidden]).smoothed()[0]
    assert (found[1].channel_sd >= plain.channel_sd).all()
    inside = np.abs(data.items[0].values[hidden] - found[0].channels[hidden]) < 3 * found[0].channel_sd[hidden]
    assert inside.all()


def test_profiles_are_refused(fitted: tuple[Run, Trajectories]) -> None:
    run, data = fitted
    with pytest.raises(UserError) as caught:
        fitting.profile(run, "theta", data)
    assert [d.code for d in caught.value.diagnostics] == ["GB772"]


@pytest.mark.parametrize("options", [TrainOptions(method="adam"), TrainOptions(forcing="autoregressive")])
def test_other_methods_and_forcings_are_refused(tmp_path: Path, options: TrainOptions) -> None:
    model = model_in(tmp_path, PROCESS)
    with pytest.raises(UserError) as caught:
        train(model, data_in(tmp_path, model), options, tmp_path / "run")
    assert {d.code for d in caught.value.diagnostics} == {"GB770"}


def test_linear_models_are_solved_exactly_whatever_the_solver(fitted: tuple[Run, Trajectories], tmp_path: Path) -> None:
    run, data = fitted
    again = train(run.model, data, replace(FAST, solver="ros34pw2"), tmp_path / "run")
    for name, constant in run.fit.constants.items():
        assert again.fit.constants[name].value == pytest.approx(constant.value, rel=1e-3)


def test_simulated_disturbances_have_their_distribution(tmp_path: Path) -> None:
    text = PROCESS.replace("diffusion X = s", "diffusion X = s\ninitial X = 1").replace("observe X", "observe X")
    model = model_in(tmp_path, text)
    subject = models.reference(model)
    from gbspec.analysis import simulate

    options = SimulateOptions(trajectories=24, span=1.0, dt=0.5, noise=0.0, seed=1)
    found = simulate(subject.evaluator, subject.model, options)
    ends = np.array([item.values[-1, 0] for item in found.items])
    variance = 0.25 / 2 * (1 - np.exp(-2.0))
    assert abs(ends.mean() - 1) < 4 * np.sqrt(variance / 24)
    assert 0.4 < ends.var() / variance < 1.9
    again = simulate(subject.evaluator, subject.model, options)
    assert np.array_equal(again.items[3].values, found.items[3].values)


def test_white_and_coloured_series_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    white = rng.standard_normal(500)
    coloured = np.convolve(white, [1, 0.8, 0.5], mode="valid")
    for series, expected in ((white, True), (coloured, False)):
        found = whiteness([series])
        assert found is not None
        assert (found.p > 0.01) == expected
        assert (found.distance_p > 0.01) == expected
    assert whiteness([white[:5]]) is None


def test_changing_variance_alone_does_not_make_a_series_coloured() -> None:
    rng = np.random.default_rng(1)
    size = np.where(np.arange(2000) // 20 % 20, 0.1, 3.0)
    rejected = []
    for _ in range(40):
        series = size * rng.standard_normal(2000)
        found = whiteness([series])
        assert found is not None
        rejected.append((found.p < 0.05, found.robust_p < 0.05))
    shares = np.mean(rejected, axis=0)
    assert shares[0] > 0.3
    assert shares[1] < 0.15
    coloured = whiteness([np.convolve(series, [1, 0.8, 0.5], mode="valid")])
    assert coloured is not None
    assert coloured.robust_p < 0.01


SENSOR = PROCESS.replace("observe X", "input u held\nobserve y = X + bias(u)").split("truth")[0]
SENSOR += "unknown bias(u in [0, 1])\n    = 0.004*nn\n    by mlp(6)\n"


def test_a_function_that_shows_only_where_noises_are_small_is_learned(tmp_path: Path) -> None:
    model = model_in(tmp_path, SENSOR)
    rng, x, step = np.random.default_rng(4), -1.0, 0.05
    a, lines, u = np.exp(-step), ["t,y,u"], rng.uniform(size=300)
    for k in range(300):
        lines.append(f"{k * step:.2f},{x + 0.004 * np.sin(6 * u[k]) + 0.0002 * rng.standard_normal():.6f},{u[k]:.6f}")
        x = 1 + a * (x - 1) + 0.005 * np.sqrt((1 - a * a) / 2) * rng.standard_normal()
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    run = train(model, read(tmp_path / "d.csv", model, Findings()), FAST, tmp_path / "run")
    at = np.linspace(0.05, 0.95, 19)
    off = Evaluator(run.member(0)).functions_many("bias", at[:, None]).ravel() - 0.004 * np.sin(6 * at)
    assert np.std(off) < 0.0004  # a constant cannot be told from the level of the process


def test_a_run_is_read_again(fitted: tuple[Run, Trajectories]) -> None:
    run, _ = fitted
    found = open_run(run.path).fit.members[0].likelihood
    assert found == run.fit.members[0].likelihood


def test_the_innovations_are_drawn(fitted: tuple[Run, Trajectories]) -> None:
    from gbspec.report.figures import innovations
    from gbspec.report.source import Source

    run, data = fitted
    assert len(innovations.build(Source(run, data)).rows[0][0].rows[0].panels) == 3


def test_figures_say_that_their_solutions_are_without_disturbances(fitted: tuple[Run, Trajectories]) -> None:
    from gbspec.report.description import Line
    from gbspec.report.figures import fit, residuals
    from gbspec.report.source import Source

    source = Source(*fitted)
    (panel,) = fit.build(source).rows[0][0].rows[0].panels
    assert panel is not None
    assert "solution without disturbances" in [mark.label for mark in panel.marks if isinstance(mark, Line)]
    titles = [one.title for one in residuals.build(source).rows[0][0].rows[0].panels if one is not None]
    assert "of the solution without disturbances" in titles


RELAXING = """model relaxing
time t
state X in [-5, 5] = 3
learn s = 0.3 in [0, 5]
unknown k(X in [-4, 4]) = 1*nn by mlp(6)
X' = k(X)*(1 - X)
diffusion X = s
observe X noise normal(0.05)
"""


def relaxing(folder: Path, rate: Callable[[float], float], disturbance: float, rows: int) -> Run:
    """A fit of data that relax to 1 with a rate which depends on the state as given."""
    model, lines, x = model_in(folder, RELAXING), ["trajectory,t,X"], 0.0
    rng = np.random.default_rng(3)
    for name, start in (("a", -3.0), ("b", 4.0)):
        x = start
        for i in range(10 * rows):
            if i % 10 == 0:
                lines.append(f"{name},{0.02 * i:.2f},{x + 0.05 * rng.standard_normal():.6f}")
            x += 0.02 * rate(x) * (1 - x) + disturbance * np.sqrt(0.02) * rng.standard_normal()
    (folder / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return train(model, read(folder / "d.csv", model, Findings()), FAST, folder / "run")


def test_a_function_that_the_data_do_not_show_stays_constant_and_is_named(tmp_path: Path) -> None:
    run = relaxing(tmp_path, lambda x: 1.0, 0.5, rows=10)
    at = np.linspace(-3, 3, 13)
    assert np.ptp(Evaluator(run.member(0)).functions_many("k", at[:, None])) < 1e-3
    assert [one for one in run.fit.warnings if "do not show how `k` changes" in one]


def test_a_function_that_the_data_show_is_kept(tmp_path: Path) -> None:
    run = relaxing(tmp_path, lambda x: 1 / (1 + np.exp(-2 * x)), 0.1, rows=40)
    at = np.linspace(-2, 3, 11)
    found = Evaluator(run.member(0)).functions_many("k", at[:, None]).ravel()
    assert np.abs(found - 1 / (1 + np.exp(-2 * at))).max() < 0.2
    assert not [one for one in run.fit.warnings if "do not show how" in one]


def test_rows_ahead_have_the_uncertainty_of_the_constants(tmp_path: Path) -> None:
    """A level with a constant speed a: h after the last row its variance is h s² + (h sd(a))² and that of the noise."""
    model = model_in(
        tmp_path,
        "model drift\nstate X in [-100, 100]\nlearn a = 0.5 in [-5, 5]\nlearn s = 0.3 in [0.001, 5]\nX' = a\n"
        "diffusion X = s\nobserve X noise normal(0.05)\n",
    )
    rng = np.random.default_rng(1)
    level = np.cumsum(np.concatenate([[0.0], 0.5 + 0.3 * rng.standard_normal(30)]))
    seen = "t,X\n" + "".join(f"{t},{x:.4f}\n" for t, x in enumerate(level + 0.05 * rng.standard_normal(31)))
    (tmp_path / "d.csv").write_text(seen, encoding="utf-8")
    (tmp_path / "ahead.csv").write_text(seen + "60,\n121,\n", encoding="utf-8")
    run = train(model, read(tmp_path / "d.csv", model, Findings()), FAST, tmp_path / "run")
    (item,) = analysing.predict(run, read(tmp_path / "ahead.csv", model, Findings(), False)).items
    a, s, far = run.fit.constants["a"], run.fit.constants["s"].value, np.array([30.0, 91.0])
    assert item.used[-2:] == ("predicted", "predicted")
    np.testing.assert_allclose(item.sd[-2:, 0] ** 2, far * s**2 + (far * a.sd) ** 2 + 0.05**2, rtol=0.05)
    given = replace(run, values={"a": a.value})
    (item,) = analysing.predict(given, read(tmp_path / "ahead.csv", model, Findings(), False)).items
    np.testing.assert_allclose(item.sd[-2:, 0] ** 2, far * s**2 + 0.05**2, rtol=0.05)


def test_the_module_of_a_linear_model_solves_the_drift(tmp_path: Path) -> None:
    """The filter's moments are exact from row to row, in one step of the whole span: no step for a solver, which gave
    1e30 where the level was 177."""
    text = DRIFT.replace("0.5 in [0.01, 10]", "30 in [20, 400]")
    model = model_in(tmp_path, text)
    run = train(model, data_in(tmp_path, model), FAST, tmp_path / "run")
    theta, mu, times = run.fit.constants["theta"].value, run.fit.constants["mu"].value, np.array([0.0, 0.05, 1.0, 30.0])
    found = run.member(run.best).simulate(np.array([mu + 2.0]), times)[:, 0].numpy()
    np.testing.assert_allclose(found, mu + 2 * np.exp(-theta * times), rtol=1e-4, atol=1e-4)


DRIFT = PROCESS.split("truth")[0]
STEPPED = DRIFT.replace("theta*(mu - X)", "theta*(mu - X^3)")
FORCED = DRIFT.replace("theta*(mu - X)", "theta*(mu*(1 + 0.2*sin(20*t)) - X)")


def test_exact_moments_have_no_step_to_check_and_max_step_changes_nothing(
    fitted: tuple[Run, Trajectories], tmp_path: Path
) -> None:
    _, data = fitted
    model, said = model_in(tmp_path, DRIFT.replace("0.5 in [0.01, 10]", "300 in [200, 4000]")), list[str]()

    class Heard:
        def update(self, update: object) -> None: ...

        def message(self, text: str) -> None:
            said.append(text)

    run = fitting.train(model, data, tmp_path / "run", replace(FAST, max_step=0.01), Heard())
    assert run.fit.step_checks[0].half_step is None  # the span of 24 times the rate of 200 is no step of a solver
    assert not any("step" in warning for warning in run.fit.warnings)
    assert any("`--max-step 0.01` changes nothing" in text for text in said)
    found = analysing.validate(run, data)
    assert found.step_check.half_step is None and "half step" not in str(found)


@pytest.mark.parametrize("text", [STEPPED, FORCED])
def test_the_step_that_is_checked_is_that_of_the_filter(text: str, tmp_path: Path) -> None:
    model = model_in(tmp_path, text)
    data = data_in(tmp_path, model)
    bad = fitting.train(model, data, tmp_path / "bad", replace(FAST, max_step=0.2))
    good = fitting.train(model, data, tmp_path / "good", replace(FAST, max_step=0.05))
    small = good.fit.step_checks[0].half_step
    assert small is not None and small < 1e-3
    assert "of predictions from row to row: half step" in str(analysing.validate(good, data))
    large = bad.fit.step_checks[0]
    assert large.half_step is not None and large.step == pytest.approx(0.2) and large.adaptive is None
    told = any("predictions from row to row depend on the step of 0.2" in warning for warning in bad.fit.warnings)
    assert told is (large.half_step > 0.01)
    assert large.half_step > 20 * small
