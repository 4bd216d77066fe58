"""Simulated tables: designs, regions, noise, failures; with a replacement of the solver by closed-form solutions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gbspec.analysis.simulation.design import measurement_times
from gbspec.analysis.simulation.simulate import SimulateOptions, simulate
from gbspec.arrays import Array
from gbspec.backends import Evaluator
from gbspec.data.fingerprints import fingerprint
from gbspec.data.sampling import fixed
from gbspec.data.signals import evaluate
from gbspec.data.table import read, write
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories
from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.diagnostics.catalogue import entries
from gbspec.ir.model import (
    Channel,
    Condition,
    Constant,
    Initial,
    Input,
    Intermediate,
    Model,
    Noise,
    Range,
    State,
    Time,
    symbol,
)
from gbspec.operations import models


def decay(**changes: object) -> Model:
    """x' = -a*x with condition a, y' = F with input F; channels x, y and twice x."""
    fields: dict[str, object] = {
        "states": (State("x", range=Range(1.0, 2.0)), State("y", start=3.0)),
        "conditions": (Condition("a", range=Range(0.5, 1.5)),),
        "inputs": (Input("F", range=Range(0.0, 2.0)),),
        "constants": (Constant("k", value=2.0),),
        "channels": (
            Channel("x", value=symbol("x"), state=0),
            Channel("y", value=symbol("y"), state=1),
            Channel("double", value=2 * symbol("x")),
        ),
        "intermediates": (Intermediate("twice", value=2 * symbol("x")),),
    }
    return Model("decay", **{**fields, **changes})  # type: ignore[arg-type]  # fields of a Model by name


class Exact:
    """The solution of `decay` in closed form; it fails above `limit`."""

    constants = np.array([2.0])

    def __init__(self, limit: float = np.inf, model: Model | None = None) -> None:
        self.limit, self.model, self.calls = limit, model or decay(), 0

    def initial(self, x0: Array, condition: Array, constants: None, inputs: tuple[Signal, ...], start: float) -> Array:
        expressed = [s.initial.kind == "expression" for s in self.model.states]
        return np.where(expressed, condition[0], x0)

    def integrate(
        self,
        x0: Array,
        times: Array,
        condition: Array,
        inputs: tuple[Signal, ...],
        start: float,
        *,
        doses: tuple[DoseEvents, ...],
        rtol: float,
    ) -> Array:
        assert rtol <= 1e-10 and times[0] >= start
        self.calls += 1
        if x0[0] > self.limit:
            raise ComputationError("too large to solve")
        fine = np.linspace(start, times[-1], 20_001)
        flow = evaluate(inputs[0], self.model.inputs[0].interpolation, fine) if inputs else np.zeros(len(fine))
        volume = np.concatenate([[0.0], np.cumsum(flow[:-1] * np.diff(fine))])
        return np.stack(
            [x0[0] * np.exp(-condition[0] * (times - start)), x0[1] + np.interp(times, fine, volume)], axis=1
        )

    def followed(self, x0: Array, times: Array, *rest: Any, **options: Any) -> tuple[Array, Array]:
        return self.integrate(x0, times, *rest, **options), np.zeros((len(times), 0))

    def observe_many(self, t: Array, x: Array, condition: Array, inputs: Array) -> Array:
        return np.stack([x[:, 0], x[:, 1], 2 * x[:, 0]], axis=1)[:, : len(self.model.channels)]


def made(model: Model | None = None, like: Trajectories | None = None, **options: object) -> Trajectories:
    model = model or decay()
    chosen = SimulateOptions(**{"trajectories": 6, "span": 2.0, "dt": 0.25, **options})  # type: ignore[arg-type]  # by name
    return simulate(Exact(model=model), model, chosen, like)


def test_regular_samples_lie_on_their_grid() -> None:
    found = made()
    assert len(found) == 6 and found.channels == ("x", "y", "double")
    for item in found.items:
        np.testing.assert_allclose(item.times, 0.25 * np.arange(1, 9))
        assert (item.counts == 1).all() and item.start == 0.25
    kept = made(keep_start=True)
    for item in kept.items:
        np.testing.assert_allclose(item.times, 0.25 * np.arange(9))
        assert 1 <= item.values[0, 0] <= 2 and item.values[0, 1] == 3.0
        assert 0.5 <= item.condition[0] <= 1.5


def test_values_are_the_solution() -> None:
    for item in made(keep_start=True).items:
        np.testing.assert_allclose(item.values[:, 0], item.values[0, 0] * np.exp(-item.condition[0] * item.times))
        np.testing.assert_allclose(item.values[:, 2], 2 * item.values[:, 0])


def test_random_inputs_are_held_within_their_range() -> None:
    for item in made(keep_start=True).items:
        (signal,) = item.inputs
        assert signal.times[0] == 0.0 and signal.times[-1] <= 2.0
        assert ((signal.values >= 0) & (signal.values <= 2)).all()
    assert max(len(item.inputs[0].times) for item in made().items) > 2


def test_inputs_start_with_what_is_recorded() -> None:
    for item in made().items:
        assert item.inputs[0].times[0] == item.start == 0.25


def test_linear_inputs_continue_to_the_end() -> None:
    model = decay(inputs=(Input("F", interpolation="linear", range=Range(0.0, 2.0)),))
    for item in made(model).items:
        assert item.inputs[0].times[-1] == item.end


def test_the_same_seed_gives_the_same_table() -> None:
    options = {"sampling": "gamma", "channels": "own-clock", "noise": 0.1, "seed": 3}
    one, two, other = made(**options), made(**options), made(**{**options, "seed": 4})
    assert [fingerprint(a) for a in one.items] == [fingerprint(a) for a in two.items]
    assert [fingerprint(a) for a in one.items] != [fingerprint(a) for a in other.items]


def test_a_trajectory_does_not_depend_on_how_many_there_are() -> None:
    few, many = made(trajectories=2, noise=0.0), made(trajectories=7, noise=0.0)
    for one, other in zip(few.items, many.items[:2], strict=True):
        assert fingerprint(one) == fingerprint(other)


def test_gamma_intervals_have_the_mean_and_the_shape() -> None:
    options = SimulateOptions(span=20_000.0, dt=0.5, sampling="gamma", keep_start=True)
    times, mask = measurement_times(options, ("x", "y"), 100.0, np.random.default_rng(0))
    intervals = np.diff(times)
    assert times[0] == 100.0 and times[-1] <= 20_100.0 and mask.all()
    assert intervals.mean() == pytest.approx(0.5, rel=0.02)
    assert intervals.std() == pytest.approx(0.25, rel=0.03)  # shape 4: half the mean


@pytest.mark.parametrize("sampling", ["regular", "gamma"])
def test_own_clocks(sampling: str) -> None:
    options = SimulateOptions(span=50.0, channels="own-clock", sampling=sampling)  # type: ignore[arg-type]  # one of the two
    times, mask = measurement_times(options, ("x", "y", "z"), 0.0, np.random.default_rng(1))
    assert (np.diff(times) > 0).all() and (mask.sum(axis=1) == 1).all()
    assert (abs(mask.sum(axis=0) - 100) < 20).all()
    own = SimulateOptions(span=11.0, channels="own-clock", clock={"y": 0.55}, keep_start=True)
    times, mask = measurement_times(own, ("x", "y"), 0.0, np.random.default_rng(1))
    np.testing.assert_allclose(times[mask[:, 0]], 0.5 * np.arange(23))
    np.testing.assert_allclose(times[mask[:, 1]], 0.55 * np.arange(21))


def test_a_fraction_of_the_channels_and_at_least_one() -> None:
    options = SimulateOptions(span=2000.0, channels="0.3")
    _, mask = measurement_times(options, ("x", "y", "z"), 0.0, np.random.default_rng(2))
    assert mask.any(axis=1).all()
    expected = 0.3 + 0.7**3 / 3  # one of three where none was drawn
    assert mask.mean() == pytest.approx(expected, abs=0.02)


def test_noise_is_relative_to_each_channels_standard_deviation() -> None:
    options: dict[str, object] = {"trajectories": 200, "dt": 0.05, "span": 2.0}
    clean, noisy = made(**options), made(**options, noise=0.2)
    exact = np.concatenate([item.values for item in clean.items])
    error = np.concatenate([item.values for item in noisy.items]) - exact
    np.testing.assert_allclose(error.std(axis=0), 0.2 * exact.std(axis=0), rtol=0.05)
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.02 * exact.std(axis=0).max())


def test_lognormal_channels_stay_positive() -> None:
    channel = Channel("x", value=symbol("x"), state=0, noise=Noise("lognormal", 0.3))
    noisy = made(decay(channels=(channel,)), trajectories=100, noise=1.0)
    clean = made(decay(channels=(channel,)), trajectories=100)
    ratio = np.concatenate([a.values / b.values for a, b in zip(noisy.items, clean.items, strict=True)])
    assert (ratio > 0).all()
    assert np.log(ratio).std() == pytest.approx(1.0, rel=0.1)


def test_boxes_override_ranges() -> None:
    found = made(
        initial={"x": (5.0, 6.0), "y": (0.0, 0.0)}, condition={"a": (2.0, 2.0), "F": (1.0, 1.0)}, keep_start=True
    )
    for item in found.items:
        assert 5 <= item.values[0, 0] <= 6 and item.values[0, 1] == 0 and item.condition.tolist() == [2]
        np.testing.assert_allclose(item.values[:, 1], item.times, atol=1e-9)


def test_given_initial_values_are_kept() -> None:
    states = (State("x", initial=Initial("expression", value=symbol("a"))), State("y", start=3.0))
    for item in made(decay(states=states), keep_start=True).items:
        assert item.values[0, 0] == item.condition[0]


def test_a_fixed_start_of_time() -> None:
    model = decay(time=Time("t", start=10.0))
    for item in made(model).items:
        assert item.start == 10.0 and item.times[0] == 10.25
        assert item.inputs[0].times[0] == 10.0


@pytest.mark.parametrize("text", ["x > 1.5", "twice > 3", "x > 3/k and t >= 0", "not x <= 1.5"])
def test_rejected_regions_are_not_entered(text: str) -> None:
    found = made(trajectories=30, reject=(text,), keep_start=True)
    assert all(item.values[0, 0] <= 1.5 for item in found.items)
    assert int(found.meta["rejected"]) > 5 and found.meta["failed"] == "0"


def test_a_region_between_two_measurements_counts() -> None:
    found = made(trajectories=20, dt=1.9, span=2.0, sampling="regular", keep_start=True, reject=("x < 0.9 and t < 1",))
    for item in found.items:
        assert item.values[0, 0] * np.exp(-item.condition[0] * 0.99) >= 0.9


def test_trajectories_that_fail_are_drawn_again_and_counted() -> None:
    model = decay()
    options = SimulateOptions(trajectories=20, span=2.0, keep_start=True)
    found = simulate(Exact(limit=1.5, model=model), model, options)
    assert int(found.meta["failed"]) > 3
    assert all(item.values[0, 0] <= 1.5 for item in found.items)


def test_repeated_failure_is_an_error() -> None:
    model = decay()
    with pytest.raises(ComputationError, match="200 could not be solved") as caught:
        simulate(Exact(limit=0.0), model, SimulateOptions(span=2.0))
    assert "too large to solve" in caught.value.what and caught.value.remedy
    with pytest.raises(ComputationError, match="200 were rejected"):
        made(reject=("x > 0",))
    with pytest.raises(ComputationError, match="fewer than two measurement times"):
        made(span=0.1, dt=5.0)


def codes(model: Model | None = None, like: Trajectories | None = None, **options: object) -> list[str]:
    with pytest.raises(UserError) as caught:
        made(model, like, **options)
    found = [d.code for d in caught.value.diagnostics]
    assert all(code in entries() for code in found if code.startswith("GB7"))
    return found


def test_options_that_do_not_fit_the_model() -> None:
    assert codes(initial={"z": (0, 1)}) == ["GB751"]
    assert codes(condition={"x": (0, 1)}) == ["GB751"]
    assert codes(channels="own-clock", clock={"a": 1.0}) == ["GB751"]
    expressed = (State("x", initial=Initial("expression", value=symbol("a"))), State("y", start=3.0))
    assert codes(decay(states=expressed), initial={"x": (0, 1)}) == ["GB752"]
    bare = decay(states=(State("x"), State("y")), conditions=(Condition("a"),), inputs=(Input("F"),))
    assert codes(bare) == ["GB753"] * 4
    assert codes(noise=-1.0, span=0.0, initial={"z": (0, 1)}) == ["GB751", "GB754", "GB754"]
    assert codes(decay(channels=())) == ["GB756"]


@pytest.mark.parametrize("text", ["x + 1", "x", "3"])
def test_a_region_must_be_a_condition(text: str) -> None:
    assert codes(reject=(text,)) != []


@pytest.mark.parametrize("text", ["x >", "z > 1", "", "x > 1 = y"])
def test_a_region_must_make_sense(text: str) -> None:
    assert codes(reject=(text,)) != []


def design(tmp_path: Path, text: str, model: Model) -> Trajectories:
    path = tmp_path / "design.csv"
    path.write_text(text)
    return read(path, model, Findings(), require_channels=False)


DESIGN = "trajectory,t,x,y,double,a,F\np,0,,,,0.7,1\np,0.5,9,,9,,\np,1,,,,,2\np,2,,9,,,\nq,5,1,1,1,0.9,0\nq,7,1,,,,\n"


def test_a_design_from_a_table(tmp_path: Path) -> None:
    model = decay()
    like = design(tmp_path, DESIGN, model)
    p, q = made(model, like, trajectories=50).items
    assert (p.label, q.label, p.start, q.start) == ("p", "q", 0.0, 5.0)
    np.testing.assert_array_equal(p.times, [0.5, 2.0])
    np.testing.assert_array_equal(p.counts, [[1, 0, 1], [0, 1, 0]])
    assert p.inputs[0].times.tolist() == [0, 1] and p.condition.tolist() == [0.7]
    assert p.values[1, 1] == pytest.approx(3 + 1 + 2, abs=1e-3)  # y starts at 3; one unit in 0..1, two in 1..2
    drawn = made(model, like, condition={"a": (1.2, 1.3)})
    assert all(1.2 <= item.condition[0] <= 1.3 for item in drawn.items)


def test_a_design_without_measurements_measures_everything(tmp_path: Path) -> None:
    model = decay()
    like = design(tmp_path, "t,a,F\n0,0.7,1\n1,,\n2,,\n", model)
    (item,) = made(model, like).items
    assert item.times.tolist() == [0, 1, 2] and (item.counts == 1).all()


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_simulated_table_reads_back(tmp_path: Path, suffix: str) -> None:
    model = decay()
    cases: Sequence[dict[str, object]] = (
        {},
        {"keep_start": True, "noise": 0.1},
        {"sampling": "gamma", "channels": "own-clock"},
        {"channels": "0.4", "sampling": "gamma", "keep_start": True},
    )
    for options in cases:
        found = made(model, None, **options)
        write(tmp_path / f"t.{suffix}", found, model)
        back = read(tmp_path / f"t.{suffix}", model, Findings())
        assert [fingerprint(a) for a in back.items] == [fingerprint(a) for a in found.items]


def test_progress_is_reported() -> None:
    told: list[tuple[int, int]] = []
    model = decay()
    simulate(Exact(), model, SimulateOptions(trajectories=3, span=2.0), progress=lambda i, n: told.append((i, n)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_values_that_are_set_are_held() -> None:
    model = decay()
    asked = SimulateOptions(trajectories=3, span=2.0, condition={"F": (0.5, 0.6)})
    options = fixed(asked, {"a": 0.9, "F": 9.0, "k": 1.0}, model)
    assert options.condition == {"a": (0.9, 0.9), "F": (0.5, 0.6)}
    assert all(item.condition.tolist() == [0.9] for item in simulate(Exact(), model, options).items)


def test_what_cannot_be_solved_is_not_tried_again_where_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bounces of a ball that falls from a given height have no end: each of 200 draws would find that anew."""
    subject, count = models.subject("bouncing_ball", {}, Findings()), 0
    followed = Evaluator.followed

    def counted(self: Evaluator, *given: object, **options: object) -> object:
        nonlocal count
        count += 1
        return followed(self, *given, **options)  # type: ignore[arg-type]  # as they were given

    monkeypatch.setattr(Evaluator, "followed", counted)
    with pytest.raises(ComputationError, match="cannot be solved, and nothing in it is drawn: events follow"):
        simulate(subject.evaluator, subject.model, SimulateOptions(1, span=10.0, dt=0.5, sampling="regular"))
    assert count == 2
