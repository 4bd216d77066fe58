"""States that are absent from a trajectory: zeros that every model has say nothing of the noise, nor of a start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis import forecast, validate
from gbspec.data import Trajectories, absent_states
from gbspec.diagnostics import Findings, UserError
from gbspec.ir import Model
from gbspec.operations import evaluating, tables
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.problem import limited
from tests.training.test_populations import model_of

TWO = """model two
time t
state x in [0, 20]
state y in [0, 20]
learn r = 0.5 in [0.01, 5]
learn s = 0.5 in [0.01, 5]
learn a = 0.1 in [0, 2]
x' = r*x*(1 - (x + a*y)/10)
y' = s*y*(1 - (y + a*x)/10)
observe x
observe y
"""


def rows(values: np.ndarray, label: str) -> list[str]:
    return [f"{label},{t},{x!r},{y!r}" for t, (x, y) in enumerate(values.tolist())]


def cultures(folder: Path, text: str = TWO) -> tuple[Model, Path]:
    """Two species in pure and in mixed culture; where one is present, its noise has the standard deviation 0.3."""
    random, t = np.random.default_rng(3), np.arange(12.0)

    def solved(x: float, y: float) -> np.ndarray:
        out, steps = [np.array([x, y])], 200
        for _ in t[1:]:
            at = out[-1]
            for _ in range(steps):
                crowd = 1 - (at + 0.3 * at[::-1]) / 10
                at = at + np.array([0.8, 0.6]) * at * crowd / steps
            out.append(at)
        found = np.array(out)
        return np.where(found > 0, np.maximum(found + 0.3 * random.standard_normal(found.shape), 0.05), 0.0)

    lines = [
        "trajectory,t,x,y",
        *rows(solved(0.6, 0), "X"),
        *rows(solved(0, 0.6), "Y"),
        *rows(solved(0.6, 0.6), "both"),
    ]
    path = folder / "cultures.csv"
    path.write_text("\n".join(lines) + "\n")
    return model_of(text, folder), path


def absent(model: Model, path: Path) -> list[list[bool]]:
    return absent_states(model, tables.read_data(path, model, Findings()).items).tolist()


def test_a_species_is_absent_where_all_is_zero_and_stays_so(tmp_path: Path) -> None:
    model, path = cultures(tmp_path)
    assert absent(model, path) == [[False, True], [True, False], [False, False]]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("y' = s*y", "y' = 0.01*x + s*y"),  # it would arise
        ("observe x", "initial y = 0\nobserve x"),  # the model says so itself
        ("observe x", "event inoculation when x > 5: y = 1\nobserve x"),
        ("observe x", "diffusion y = 0.1\nobserve x"),
    ],
)
def test_no_other_zero_is_an_absence(old: str, new: str, tmp_path: Path) -> None:
    model, path = cultures(tmp_path, TWO.replace(old, new))
    assert absent(model, path)[0] == [False, False]


def test_a_promise_of_zero_keeps_a_state_there(tmp_path: Path) -> None:
    text = TWO.replace("observe x\n", "unknown f(y) zero at y = 0 by mlp(3)\nobserve x\n")
    model, path = cultures(tmp_path, text.replace("y' = s*y", "y' = f + s*y"))
    assert absent(model, path)[0] == [False, True]


def test_states_that_feed_each_other_are_absent_together(tmp_path: Path) -> None:
    model, path = cultures(
        tmp_path, TWO.replace("y' = s*y", "y' = 0.1*x + s*y").replace("x' = r*x", "x' = 0.1*y + r*x")
    )
    text = path.read_text().replace("both", "neither")
    head, *lines = text.splitlines()
    path.write_text("\n".join([head, *(f"neither,{t},0,0" for t in range(6)), *lines[:12]]) + "\n")
    assert absent(model, path) == [[True, True], [False, False]]


def test_every_channel_of_a_state_has_to_be_zero(tmp_path: Path) -> None:
    model, path = cultures(tmp_path, TWO + "observe again = y\n")
    head, *lines = path.read_text().splitlines()
    path.write_text("\n".join([head + ",again", *(f"{line},{k % 3}" for k, line in enumerate(lines))]) + "\n")
    assert absent(model, path) == [[False, False], [True, False], [False, False]]


def test_predictions_of_what_is_absent_are_zero_and_certain(tmp_path: Path) -> None:
    model, path = cultures(tmp_path)
    run = train(model, tables.read_data(path, model, Findings()), TrainOptions(effort="low"), tmp_path / "run")
    path.write_text("trajectory,t,x,y\n" + "\n".join(f"new,{t},{0.7 + 0.1 * t},0" for t in range(8)) + "\n")
    for window in (None, 4):
        (item,) = forecast(run, tables.read_data(path, model, Findings()), window=window).items
        y = run.model.channels[1].name
        assert y == "y" and not item.mean[:, 1].any()
        assert item.sd[:, 1] == pytest.approx(np.full(8, run.fit.noise["y"]), rel=1e-6)
        assert item.mean[-1, 0] > 2


def measured(run: Run, data: Trajectories) -> np.ndarray:
    """The values [channel, row] that predictions are compared with."""
    return np.concatenate([item.measured for item in forecast(run, data).items]).T


def test_zeros_of_absence_do_not_count(tmp_path: Path) -> None:
    model, path = cultures(tmp_path)
    run = train(model, tables.read_data(path, model, Findings()), TrainOptions(), tmp_path / "run")
    fit = run.fit
    channels = fit.members[0].channels
    assert {name: one.values for name, one in channels.items()} == {"x": 24, "y": 24}
    again = tables.read_data(path, model, Findings())
    for name, errors in validate(run, again).channels.items():
        assert (errors.n, errors.r2) == (24, pytest.approx(channels[name].r2, abs=1e-3))
    assert {name: int(np.isfinite(values).sum()) for name, values in zip("xy", measured(run, again), strict=True)} == {
        "x": 24, "y": 24,
    }  # fmt: skip
    assert fit.noise["x"] == pytest.approx(0.3, rel=0.35)
    assert fit.noise["y"] == pytest.approx(0.3, rel=0.35)
    starts = run.member().weights["initial"]
    assert (starts[0, 1], starts[1, 0]) == (0.0, 0.0)
    assert starts[2].min() > 0.1
    assert fit.constants["r"].value == pytest.approx(0.8, abs=3 * fit.constants["r"].sd)


def test_under_log_normal_noise_absence_is_written_as_zeros_too(tmp_path: Path) -> None:
    text = TWO.replace("observe x\nobserve y", "observe x noise lognormal(0.2)\nobserve y noise lognormal(0.2)")
    model, path = cultures(tmp_path, text)
    data = tables.read_data(path, model, Findings())
    run = train(model, data, TrainOptions(effort="low"), tmp_path / "run")
    assert {name: one.values for name, one in run.fit.members[0].channels.items()} == {"x": 24, "y": 24}
    starts = run.member().weights["initial"]
    assert (starts[0, 1], starts[1, 0]) == (0.0, 0.0)
    assert run.fit.constants["r"].value == pytest.approx(0.8, rel=0.3)
    assert {name: one.n for name, one in validate(run, data).channels.items()} == {"x": 24, "y": 24}
    assert len(evaluating.of_run(run, data).to_frame()) == 48
    path.write_text("trajectory,t,x,y\n" + "\n".join(f"new,{t},{0.7 + 0.1 * t},0" for t in range(8)) + "\n")
    for window in (None, 4):
        (item,) = forecast(run, tables.read_data(path, model, Findings()), window=window).items
        assert not item.mean[:, 1].any() and not item.sd[:, 1].any() and np.isfinite(item.sd[:, 0]).all()
        assert 1 < item.mean[-1, 0] < 10


def test_replicates_of_absence_have_no_logarithms(tmp_path: Path) -> None:
    model = model_of(TWO.replace("observe y", "observe y noise lognormal(0.2)"), tmp_path)
    path = tmp_path / "long.csv"
    lines = ["trajectory,t,name,value,sd"]
    lines += [f"a,{t},{name},{value},0.1" for t in range(3) for name, value in (("x", 2), ("x", 8), ("y", 0), ("y", 0))]
    path.write_text("\n".join([*lines, "b,0,x,1,0.1", "b,0,y,2,0.1", "b,0,y,8,0.1"]) + "\n")
    first, second = tables.read_data(path, model, Findings()).items
    assert first.values[0].tolist() == [5.0, 0.0] and second.values[0, 1] == pytest.approx(4.0)
    assert first.scatter is not None and first.scatter[:, 1].tolist() == [0.0, 0.0, 0.0]
    assert first.sd[:, 1] == pytest.approx([0.1 * np.sqrt(2) / 2] * 3)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("y' = s*y", "y' = 0.01*x + s*y", "the balance of `y` is not 0 where `y` is 0"),
        ("observe x", "initial y = 0\nobserve x", "the start of `y` is given in the model"),
        ("observe x", "initial y learn\nobserve x", "the start of `y` is learned in the model"),
        ("observe x", "event inoculation when x > 5: y = 1\nobserve x", "a dose or an event changes `y`"),
        ("observe x", "diffusion y = 0.1\nobserve x", "none is taken to be so in a model with disturbances"),
        ("observe y", "observe z = 2*y", "`z` is an expression and no state"),
    ],
)
def test_other_zeros_have_no_logarithm(old: str, new: str, reason: str, tmp_path: Path) -> None:
    text = TWO.replace(old, new).replace("observe y", "observe y noise lognormal(0.2)")
    model, path = cultures(tmp_path, text.replace("2*y", "2*y noise lognormal(0.2)"))
    path.write_text(path.read_text().replace("x,y", f"x,{model.channels[1].name}"))
    with pytest.raises(UserError) as caught:
        tables.read_data(path, model, Findings())
    found = caught.value.diagnostics
    assert {d.code for d in found} == {"GB724"} and found[0].place.row == 2
    assert reason in found[0].help


def test_a_zero_among_other_values_has_no_logarithm(tmp_path: Path) -> None:
    model = model_of(TWO.replace("observe y", "observe y noise lognormal(0.2)"), tmp_path)
    path = tmp_path / "zero.csv"
    for values, said in (((0, 3), "a state that is absent"), ((0, -3), "negative values")):
        path.write_text("t,x,y\n0,1,1\n" + "\n".join(f"{t},1,{y}" for t, y in enumerate(values, 1)) + "\n")
        with pytest.raises(UserError) as caught:
            tables.read_data(path, model, Findings())
        assert said in caught.value.diagnostics[0].help


def test_residuals_of_two_kinds_count_in_full() -> None:
    random = np.random.default_rng(1)
    column = np.concatenate([np.zeros(40), random.standard_normal(60)])
    assert np.sqrt(np.mean(limited(column) ** 2)) == pytest.approx(np.sqrt(np.mean(column**2)))
    few = np.concatenate([random.standard_normal(97), np.full(3, 50.0)])
    assert limited(few).max() < 6
    assert len(limited(np.zeros(0))) == 0
