"""From a run to arrays: solutions, truths, residuals and values of unknowns are the ones they are called."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec import frontend
from gbspec.backends.module import load_module
from gbspec.data.sampling import SimulateOptions
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories, Trajectory
from gbspec.diagnostics import Findings, UserError
from gbspec.operations import models, tables
from gbspec.report import collect
from gbspec.report.description import Span
from gbspec.report.figures.functions import slice_panel
from gbspec.report.figures.summary import liveliest
from gbspec.report.files import draw
from gbspec.report.kinds import KINDS
from gbspec.report.unknowns import Expression, argument_units, learned_functions, postulate_of, truth_of
from gbspec.runs.record import ConstantRecord, DataRecord, FitRecord, MemberRecord, OwnRecord
from gbspec.runs.store import Run
from tests.texts import model_of

TEXT = """\
model growth "Growth on a substrate, twice"
condition D in [0.05, 0.2]
state X in [0, 10] = 1
state S in [0, 10] = 5
learn Y = 0.5 in [0.1, 2]
unknown mu(S) = S/(2 + S)*nn by mlp(4)
X' = mu(S)*X - D*X
S' = -mu(S)*X/Y + D*(5 - S) + 0.1*mu(2*S)
observe X
observe total = X + S
initial X = 1
initial S = 5
truth Y = 0.4
truth mu(S) = 0.5*S/(1 + S)
"""


def written(folder: Path, text: str) -> Run:
    """A run of two members whose weights are random: what is drawn does not depend on how good they are."""
    (folder / "growth.gb").write_text(text)
    model = frontend.load_model(folder / "growth.gb", Findings())
    for member in (0, 1):
        place = folder / "members" / str(member)
        place.mkdir(parents=True)
        load_module(model).random(seed=member).save(place / "weights.safetensors")
    constants = {"Y": ConstantRecord(0.5, 0.1, (0.4, 0.6), 0.5, (0.5, 0.5))}
    members = tuple(MemberRecord(k, loss, {}, 0.0, ()) for k, loss in enumerate((2.0, 1.0)))
    fit = FitRecord("0", model.name, DataRecord("", "", 3, 0, 0), {}, {}, constants, {}, members, ())
    return Run(folder, model, fit, (0, 1))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return written(tmp_path_factory.mktemp("collect"), TEXT)


@pytest.fixture(scope="module")
def data(run: Run) -> Trajectories:
    """Noise-free measurements of the truth."""
    options = SimulateOptions(trajectories=3, span=4.0, keep_start=True)
    return tables.simulate(models.reference(run.model), options)


@pytest.fixture(scope="module")
def fitted(run: Run, data: Trajectories) -> collect.Fitted:
    return collect.Fitted(run, data)


def test_the_truth_passes_through_noise_free_measurements(fitted: collect.Fitted, data: Trajectories) -> None:
    item = data.items[1]
    found = fitted.true_solution(1, item.times)
    assert found is not None
    np.testing.assert_allclose(found[1], item.values, rtol=1e-6)


def test_members_have_solutions_of_their_own(fitted: collect.Fitted, data: Trajectories) -> None:
    states, channels = fitted.solutions(0, data.items[0].times)
    assert states.shape == (2, len(data.items[0].times), 2)
    np.testing.assert_allclose(channels[:, :, 1], states.sum(axis=2))
    assert np.abs(states[0] - states[1]).max() > 0


def test_a_fit_shows_what_was_measured_and_nothing_else(fitted: collect.Fitted, data: Trajectories) -> None:
    hidden = data.items[0].values.copy()
    hidden[::2, 0] = np.nan
    item = replace(data.items[0], values=hidden)
    (shown,) = collect.trajectory_fits(collect.Fitted(fitted.run, replace(data, items=(item,))), [0])
    first, second = shown.channels
    assert len(first.times) == np.isfinite(hidden[:, 0]).sum() < len(second.times)
    assert first.grid[0] == item.start
    assert first.grid[-1] == item.end
    assert shown.condition.startswith("D = ")


def test_residuals_are_those_of_the_fit(fitted: collect.Fitted, data: Trajectories) -> None:
    fits = [fitted.solutions(i, item.times)[1].mean(axis=0)[:, 0] for i, item in enumerate(data.items)]
    measured = np.concatenate([item.values[:, 0] for item in data.items])
    expected = (np.concatenate(fits) - measured) / np.std(measured)
    found = collect.residuals(fitted)[0]
    order = np.lexsort((found.residual, found.times))
    other = np.lexsort((expected, np.concatenate([item.times for item in data.items])))
    np.testing.assert_allclose(found.residual[order], expected[other], rtol=1e-9)


def test_residuals_are_of_logarithms_where_the_fit_was(tmp_path: Path) -> None:
    run = written(tmp_path, TEXT.replace("observe X\n", "observe X noise lognormal(0.2)\n"))
    options = SimulateOptions(trajectories=2, span=4.0, keep_start=True)
    fitted = collect.Fitted(run, tables.simulate(models.reference(run.model), options))
    item = fitted.data.items[0]
    ratio = fitted.solutions(0, item.times)[1].mean(axis=0)[:, 0] / item.values[:, 0]
    first, second = collect.residuals(fitted)
    assert (first.logarithmic, second.logarithmic) == (True, False)
    # The only channel with a stated noise: its scale is the deviation of its logarithms
    logs = np.log(np.concatenate([one.values[:, 0] for one in fitted.data.items]))
    expected = np.log(ratio) / logs.std()
    assert np.isin(expected.round(9), first.residual.round(9)).all()
    assert np.abs(expected).max() > 1e-3


def test_every_application_of_an_unknown_is_visited(fitted: collect.Fitted, data: Trajectories) -> None:
    points = collect.visited(fitted, 0, limit=10**6)
    substrate = np.concatenate([fitted.solutions(i, item.times)[0][0][:, 1] for i, item in enumerate(data.items)])
    # the module calls each network once for equal arguments
    np.testing.assert_allclose(np.sort(points[:, 0]), np.sort(np.concatenate([substrate, 2 * substrate])))


def test_truth_and_postulate_are_evaluated_where_asked(fitted: collect.Fitted) -> None:
    s = np.array([[0.5], [2.0], [8.0]])
    truth, postulate = truth_of(fitted.model, "mu"), postulate_of(fitted, fitted.model.unknowns[0])
    assert truth is not None
    assert postulate is not None
    np.testing.assert_allclose(truth(s), 0.5 * s[:, 0] / (1 + s[:, 0]), rtol=1e-14)
    np.testing.assert_allclose(postulate(s), s[:, 0] / (2 + s[:, 0]), rtol=1e-14)


def test_parameters_hide_constants_of_the_same_name(fitted: collect.Fitted) -> None:
    truth = fitted.model.truth_functions[0]
    constants = models.reference(fitted.model).model.constants
    value = Expression(truth.value, truth.parameters, (*constants, replace(constants[0], name="S", value=1e9)))
    np.testing.assert_allclose(value(np.array([[1.0]])), 0.25)


def test_learned_functions_follow_the_members(fitted: collect.Fitted) -> None:
    (found,) = learned_functions(fitted)
    (piece,) = found.slices
    assert piece.members.shape[0] == 2
    direct = fitted.evaluators[1].functions_many("mu", piece.x[:, None])
    np.testing.assert_allclose(piece.members[1], direct)
    assert found.plane is None


def test_the_trained_range_is_that_of_the_weights_where_it_has_a_width(fitted: collect.Fitted) -> None:
    weights = fitted.evaluators[0].instance.weights
    for low, high, trained in ((0.5, 4.0, (0.5, 4.0)), (1.0, 1.0, None)):
        weights |= {"network.mu.input_low": np.array([low]), "network.mu.input_high": np.array([high])}
        (found,) = learned_functions(fitted)
        assert found.slices[0].trained == trained
        grounds = [mark for mark in slice_panel("mu", found.slices[0]).marks if isinstance(mark, Span)]
        assert bool(grounds) == (trained is not None)
    for end in ("low", "high"):
        del weights[f"network.mu.input_{end}"]


def test_constants_stand_beside_their_truths(run: Run) -> None:
    (found,) = collect.constants(run)
    assert (found.name, found.value, found.interval, found.truth, found.start) == ("Y", 0.5, (0.4, 0.6), 0.4, 0.5)


def test_the_liveliest_trajectory_changes_most(data: Trajectories) -> None:
    wild = replace(
        data.items[2], values=data.items[2].values * np.where(np.arange(len(data.items[2].times)) % 2, 1, 9)[:, None]
    )
    assert liveliest(replace(data, items=(*data.items[:2], wild))) == 2


NOT_THERE = (
    "history",
    "initial-states",
    "innovations",
    "per-trajectory",
    "prediction-errors",
    "predictive-check",
    "weighted-residuals",
)


@pytest.mark.parametrize("kind", [kind.name for kind in KINDS if kind.name not in NOT_THERE])
def test_every_kind_is_drawn(run: Run, data: Trajectories, kind: str) -> None:
    assert draw(kind, run, data).axes


def test_initial_states_that_were_not_learned_are_said(run: Run, data: Trajectories) -> None:
    # The model gives them, so the run holds none that could be compared.
    with pytest.raises(UserError, match="GB876"):
        draw("initial-states", run, data)


def test_a_history_that_is_not_there_is_said(run: Run, data: Trajectories, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="history"):
        draw("history", run, data)


CONTRACT = """\
model contract
condition g in [0, 5]
state u in [0, 5] = 1
unknown mu(u, g in [0, 5]) >= 0, zero at u = 0, increasing in u by mlp(4)
u' = 0.5 - mu(u, g)
observe u
initial u = 1
truth mu(u, g) = u/(1 + g)
"""


@pytest.mark.parametrize("kind", ["functions", "parity"])
def test_an_unknown_whose_contract_needs_raw_outputs_is_drawn(tmp_path: Path, kind: str) -> None:
    run = written(tmp_path, CONTRACT)
    data = tables.simulate(models.reference(run.model), SimulateOptions(trajectories=2, span=2.0, keep_start=True))
    points = collect.visited(collect.Fitted(run, data), 0)
    assert {float(value) for value in points[:, 1]} >= {float(item.condition[0]) for item in data.items}
    assert draw(kind, run, data).axes


DOSED = """\
model dosed
time t : h
input feed held : mg/h
state A in [0, 500] : mg
learn k = 0.5 in [0, 5] per trajectory : 1/h
A' = feed - k*A
dose A
initial A = 0
observe A
"""


def test_inputs_and_doses_are_those_of_the_data(tmp_path: Path) -> None:
    run = written(tmp_path, DOSED)
    own = {"1": OwnRecord(0.4, 0.1, (0.3, 0.5))}
    constants = {"k": ConstantRecord(0.4, None, None, 0.5, (0.4,), own)}
    run = replace(run, fit=replace(run.fit, constants=constants))
    times = np.array([0.0, 1.0, 2.0, 4.0])
    item = Trajectory("1", 0.0, times, np.ones((4, 1)), np.ones((4, 1)), np.full((4, 1), np.nan), np.zeros(0),
                      (Signal(np.array([0.0, 2.0]), np.array([1.0, 3.0])),),
                      (DoseEvents(np.array([0.0, 1.0]), np.array([10.0, 20.0])),))  # fmt: skip
    (shown,) = collect.trajectory_fits(collect.Fitted(run, Trajectories((item,), ("A",))), [0])
    feed, dose = shown.given
    assert (feed.name, feed.unit, dose.name, dose.unit) == ("feed", "mg/h", "dose, A", "mg")
    corners = [(0.0, 1.0), (2.0, 1.0), (2.0, 3.0), (4.0, 3.0)]
    assert list(zip(feed.times, feed.values, strict=True)) == corners
    np.testing.assert_array_equal(dose.values, [10.0, 20.0])
    (channel,) = shown.channels
    assert channel.unit == "mg", "a channel of a state has its unit"
    for time, amount in ((0.0, 10.0), (1.0, 20.0)):
        at = int(np.searchsorted(channel.grid, time))
        jump = channel.members[0, at + 1] - channel.members[0, at]
        np.testing.assert_allclose(jump, amount, rtol=1e-6)
    assert shown.own == "k = 0.4 (0.3 to 0.5) 1/h"
    assert shown.origin == "given by the model", "and not learned"


def test_arguments_have_the_unit_of_what_the_unknown_is_applied_to() -> None:
    """Where it is applied to different things, or to expressions, only a unit that is declared with it is known."""
    text = """model m
time t : s
state w : rad/s in [-9, 9] = 1
state v : rad/s in [-9, 9] = 1
unknown f(w) : rad/s^2 by mlp(2)
unknown g(a) : rad/s^2 by mlp(2)
unknown h(a, b : rad) : rad/s^2 by mlp(2)
const tau : s = 1
w' = -f(w) + h(v, w*tau)
v' = -g(v) - g(w)
observe w
"""
    model = model_of(text)
    units = [argument_units(model, one) for one in model.unknowns]
    assert units == [("rad/s",), ("",), ("rad/s", "rad")]


def test_what_is_measured_or_an_argument_has_the_unit_of_its_declaration() -> None:
    """Of a `let` and an algebraic variable too."""
    text = """model m
time t : s
state w : rad/s in [0.1, 9] = 1
const tau : s/rad = 1
const c : rad/s^3 = 1
let v : rad/s = 2*w
let u = w
algebraic p : kPa in [0, 20] = 2
const a : kPa*s/rad = 1
const b : kPa = 1
equation ideal: p = a*v + b*exp(-p/b)
unknown f(p) : rad/s^2 by mlp(2)
unknown g(x) : rad/s^2 by mlp(2)
unknown h(x) : rad/s^2 by mlp(2)
w' = -f(p) - g(v) - h(u)
observe w
observe v
observe p
"""
    model = model_of(text)
    assert [collect.channel_unit(model, one) for one in model.channels] == ["rad/s", "rad/s", "kPa"]
    assert [argument_units(model, one) for one in model.unknowns] == [("kPa",), ("rad/s",), ("rad/s",)]
    found = collect.units(model)
    assert found["w"] == "rad/s" and found["p"] == "kPa" and found["v"] == "rad/s"


def test_an_interval_has_the_digits_that_its_width_needs() -> None:
    from gbspec.report.text import ends_of

    assert ends_of((1.622, 1.707)) == "1.622 to 1.707"
    assert ends_of((2.9076e-6, 2.9145e-6)) == "2.9076e-06 to 2.9145e-06"
    assert ends_of((0.02999996, 0.03000004)) == "0.02999996 to 0.03000004"
    assert ends_of((0.1, 100.0)) == "0.1 to 100" and ends_of(None) == "-" and ends_of((2.0, 2.0)) == "2 to 2"
