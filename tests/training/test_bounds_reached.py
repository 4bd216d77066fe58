"""A constant that a bound stopped is told, and gets no interval."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

import gbspec
from gbspec.runs import ChannelRecord, ConstantRecord, how_followed
from gbspec.training.problem import Bijection, Bijections
from gbspec.training.runs.constants import (
    at_bounds,
    inside_bounds,
    near_bounds,
    said_of_constants,
    undetermined,
    unsettled,
)
from gbspec.training.runs.summary import MemberResult
from tests.training.conftest import model_of

TEXT = """\
model m
state x in [0, 2]
learn k = 1 in [0, 2]
x' = -k*x
initial x = 1
observe x
"""


def member(channel: ChannelRecord, k: float) -> MemberResult:
    """What is asked of a member here."""
    known = {"channels": {"x": channel}, "constants": {"k": k}, "sd": {"k": 1.0}}
    none = frozenset[str]()
    found = SimpleNamespace(
        tied=[],
        notes=[],
        vanished=none,
        misjudged=none,
        misjudged_own=none,
        open_own=none,
        untested=none,
        bounded_own=none,
        finished=True,
        likelihood=None,
        **known,
    )
    return cast(MemberResult, found)


@pytest.mark.parametrize(("k", "wanted"), [(2.0 - 1e-7, [("k", 2.0)]), (1e-6, [("k", 0.0)]), (1.9, []), (0.01, [])])
def test_what_ended_at_a_bound(tmp_path: Path, k: float, wanted: list[tuple[str, float]]) -> None:
    (tmp_path / "m.gb").write_text(TEXT)
    model = gbspec.load(tmp_path / "m.gb").model
    assert at_bounds(model, {"k": k}) == wanted
    assert at_bounds(model, {"k": k}, {"k": 0.0}) == wanted  # the map is flat at a bound: that is no knowledge


@pytest.mark.parametrize(
    ("bounds", "k", "sd", "wanted"),
    [
        ("in [0.005, 5] = 0.2", 4.9996, 0.0028, [("k", 5.0)]),
        ("in [10, 90] = 60", 10.334, 4.0, [("k", 10.0)]),
        ("in [10, 90] = 60", 14.0, 4.0, []),
        ("in [0.01, 50] = 3", 0.01002, 46.0, [("k", 0.01)]),
        ("in [0.01, 50] = 3", 0.012, 46.0, []),
        ("in [0, 50] = 0.1", 49.9046, 7.1, [("k", 50.0)]),  # 75 times nearer to the bound than its deviation
        ("in [0, 50] = 0.1", 49.5, 7.1, []),
        ("in [0, 50] = 0.1", 49.9046, 20.0, []),
        ("in [0, 1] = 0.5", 0.75, 4.8, []),
        ("> 0 = 0.5", 0.01, 0.4, []),
        ("in [10, 90] = 60", 10.334, float("nan"), []),
    ],
)
def test_a_constant_far_closer_to_a_bound_than_its_standard_deviation_is_at_it(
    tmp_path: Path, bounds: str, k: float, sd: float, wanted: list[tuple[str, float]]
) -> None:
    """Its interval on the scale of training, which ends at the bound, would reach from 0.15 to 5 beside 0.0028."""
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", f"k {bounds}"))
    model = gbspec.load(tmp_path / "m.gb").model
    assert at_bounds(model, {"k": k}, {"k": sd}) == wanted
    result = member(ChannelRecord(0.9, 0.2), k)
    found = said_of_constants(model, {}, [(0, *each) for each in wanted], {0: result})
    assert len(found) == len(wanted)
    assert all(f"`k` ended at {k:.5g}, beside its bound" in one for one in found)


@pytest.mark.parametrize(("rate", "stopped"), [(5.0, True), (1.5, False)])
def test_a_fit_says_so(tmp_path: Path, rate: float, stopped: bool) -> None:
    (tmp_path / "m.gb").write_text(TEXT.replace("state x", "time t from 0\nstate x"))
    noisy = zip((0.1, 0.2, 0.4, 0.8, 1.0), (1.01, 0.99, 0.995, 1.02, 0.99), strict=True)
    rows = "".join(f"{t},{2.718281828 ** (-rate * t) * factor}\n" for t, factor in noisy)
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    assert any("`k` ended at its bound 2" in warning for warning in fit.warnings) is stopped
    assert (fit.constants["k"].interval is None) is stopped


@pytest.mark.parametrize("also", ["", "learn b = 0.9 in [0.2, 5]"])
def test_a_constant_of_a_trajectory_that_ended_at_its_bound_is_told_so(tmp_path: Path, also: str) -> None:
    """Not that the data leave it open, nor that the curvature does; the second trajectory does not decay at all."""
    rate = "-k*x*b" if also else "-k*x"
    (tmp_path / "m.gb").write_text(
        f"model m\ntime t from 0\nstate x in [0, 2]\nlearn k = 0.5 in [0.04, 10] per trajectory\n{also}\n"
        f"x' = {rate}\ninitial x = 1\nobserve x\n"
    )
    random, lines = np.random.default_rng(1), ["trajectory,t,x"]
    for label, k in (("a", 1.0), ("b", 0.0), ("c", 2.0)):
        values = np.exp(-k * np.arange(1, 9) / 4) + 0.02 * random.standard_normal(8)
        lines += [f"{label},{t / 4},{value:.4f}" for t, value in enumerate(values, 1)]
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    each = fit.constants["k"].per_trajectory
    assert each is not None and each["b"].interval is None
    (said,) = [text for text in fit.warnings if "`k` of `b`" in text]
    assert "`k` of `b` ended at its bound 0.04, where no interval holds; widen the bounds" in said
    assert not any("`k` has no interval" in text for text in fit.warnings), fit.warnings


@pytest.mark.parametrize(
    ("bounds", "value", "sd"),
    [("in [0, 1]", 0.75, 4.8), ("> 0", 0.1, 0.2), ("< 3", 2.9, 0.5), ("in [0, 1]", 0.9999, 1.0)],
)
def test_an_interval_lies_within_the_bounds(tmp_path: Path, bounds: str, value: float, sd: float) -> None:
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", f"k = 0.5 {bounds}"))
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    found = inside_bounds(learnable, value, sd)
    assert found is not None
    assert learnable.range.low <= found[0] < value < found[1] <= learnable.range.high


@pytest.mark.parametrize(
    ("bounds", "value", "sd", "wanted"),
    [
        ("in [0, 50]", 18.97, 183.0, (0.0, 50.0)),
        ("in [0, 50]", 49.0, 20.0, (0.0, 50.0)),
        ("in [1, 1000]", 270.8, 3800.0, (1.0, 1000.0)),
        ("in [0, 50]", 1e-7, 1e-8, (8.48e-8, 1.179e-7)),
        ("> 0", 1e-7, 1e-8, (8.48e-8, 1.179e-7)),
    ],
)
def test_an_end_that_cannot_be_told_from_a_bound_is_the_bound(
    tmp_path: Path, bounds: str, value: float, sd: float, wanted: tuple[float, float]
) -> None:
    """6.36e-51 is what is left of the scale on which constants are trained, and no number of these data."""
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", f"k = 20 {bounds}"))
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    found = inside_bounds(learnable, value, sd)
    assert found == (wanted if wanted[1] in (50.0, 1000.0) else pytest.approx(wanted, rel=1e-3))


@pytest.mark.parametrize("bounds", ["in [0, 2]", "> 0", ""])
def test_a_narrow_interval_is_symmetrical(tmp_path: Path, bounds: str) -> None:
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", f"k = 0.5 {bounds}"))
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    assert inside_bounds(learnable, 0.8, 1e-4) == pytest.approx((0.8 - 1.645e-4, 0.8 + 1.645e-4), abs=1e-7)


@pytest.mark.parametrize(
    ("k", "wanted"), [(0.5, []), (1.001e-5, []), (1e-5, [("k", 1e-5)]), (9.9e4, []), (1e5, [("k", 1e5)])]
)
def test_far_apart_bounds_are_reached_on_the_scale_of_logarithms(
    tmp_path: Path, k: float, wanted: list[tuple[str, float]]
) -> None:
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", "k in [1e-5, 1e5] = 0.03"))
    model = gbspec.load(tmp_path / "m.gb").model
    assert at_bounds(model, {"k": k}) == wanted
    assert at_bounds(model, {"k": k}, {"k": 0.0}) == wanted  # the map is flat at a bound: that is no knowledge


@pytest.mark.parametrize(
    ("bounds", "interval", "said"),
    [
        ("in [0, 1]", (0.02, 0.98), True),
        ("in [0, 1]", (0.2, 0.98), False),
        ("in [1e-5, 1e5]", (2e-5, 8e4), True),
        ("in [1e-5, 1e5]", (1.0, 9.9e4), False),
        ("> 0", (1e-9, 1e9), False),
        ("in [0, 1]", None, False),
    ],
)
def test_an_interval_that_covers_the_bounds_is_said_to_tell_nothing(
    tmp_path: Path, bounds: str, interval: tuple[float, float] | None, said: bool
) -> None:
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", f"k = 0.5 {bounds}"))
    model = gbspec.load(tmp_path / "m.gb").model
    found = undetermined(model, {"k": ConstantRecord(0.5, 0.01, interval, 0.5, (0.5,), None)})
    assert bool(found) is said
    assert all("`k` is not determined" in text for text in found)


def test_constants_that_are_not_determined_share_a_warning(tmp_path: Path) -> None:
    text = TEXT.replace("k = 1 in [0, 2]", "k = 0.5 in [0, 1]\nlearn a = 0.5 in [0, 1]\nlearn b = 0.5 in [0, 1]")
    (tmp_path / "m.gb").write_text(text.replace("x' = -k*x", "x' = -(k + a + b)*x"))
    model = gbspec.load(tmp_path / "m.gb").model
    known = ConstantRecord(0.5, 0.01, (0.01, 0.99), 0.5, (0.5,), None)
    (said,) = undetermined(model, dict.fromkeys("kab", known))
    assert said.startswith("`k`, `a` and `b` are not determined by these data: their 90 % intervals cover their bounds")
    (said,) = undetermined(model, {"k": known})
    assert "`k` is not determined by these data: its 90 % interval, 0.01 to 0.99, covers its bounds" in said


def test_a_constant_at_its_bound_is_not_said_to_be_undetermined(tmp_path: Path) -> None:
    """Its standard deviation is small; on the logistic scale of the bounds it is huge, and the interval covers them."""
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", "k = 0.3 in [0.05, 0.6]"))
    model = gbspec.load(tmp_path / "m.gb").model
    (said,) = undetermined(model, {"k": ConstantRecord(0.59961, 0.004, (0.05004, 0.6), 0.59961, (0.59961,), None)})
    assert "`k` lies at its bound 0.6" in said and "not determined" not in said


def test_a_fit_says_that_its_constant_is_not_determined(tmp_path: Path) -> None:
    """Noise hides all that these times tell of k, whose best value is 1."""
    (tmp_path / "m.gb").write_text(TEXT)
    noise = ((0.001, 0.1), (0.002, -0.1), (0.003, -0.1), (0.004, 0.1))
    rows = "".join(f"{t},{1 - t + s}\n" for t, s in noise)
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    assert any("`k` is not determined" in warning for warning in fit.warnings), fit.warnings


@pytest.mark.parametrize("bounds", ["", "> 0", "< 3", "in [0, 2]", "in [-9, -1]", "in [1e-3, 1e3]", "in [-1e3, -1e-3]"])
@pytest.mark.parametrize("share", [0.0, 1e-3])
def test_values_inside_stay_and_those_at_bounds_move_in(tmp_path: Path, bounds: str, share: float) -> None:
    start = {"in [-9, -1]": -4.0, "in [-1e3, -1e-3]": -2.0}.get(bounds, 1.5)
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", f"k = {start} {bounds}"))
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    scale, ends = Bijection.of(learnable), (learnable.range.low, learnable.range.high)
    assert scale.inside(start, share) == pytest.approx(start, rel=1e-12)
    for end in filter(np.isfinite, ends):
        assert scale.distance(scale.inside(end, share), end) == pytest.approx(share, abs=1e-12)


FAST = """\
model fast
time t : s from 0
state C in [0, 20]
state R in [0, 20]
learn k = 0.2 in [0.001, 10]
learn s = 5 in [0.01, 100]
learn d = 1 in [0.01, 100]
C' = -k*C
R' = s - d*R*(1 + 0.1*C)
observe C
observe R
"""


def test_a_constant_that_follows_from_another_ones_bound_has_no_interval(tmp_path: Path) -> None:
    """Of a response that is at rest in all rows the data show s/d alone; both rates may be anything that is large."""
    random, t = np.random.default_rng(5), np.arange(0, 31, 3.0)
    rows = ["trajectory,t,C,R"]
    for j, start in enumerate((10.0, 6.0, 14.0)):
        c = start * np.exp(-0.1 * t)
        each = (t, c + 0.05 * random.normal(size=11), 5 / (1 + 0.1 * c) + 0.02 * random.normal(size=11))
        rows += [f"{j},{','.join(f'{value:.4f}' for value in row)}" for row in zip(*each, strict=True)]
    (tmp_path / "m.gb").write_text(FAST)
    (tmp_path / "d.csv").write_text("\n".join(rows) + "\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run").run.fit
    assert fit.constants["k"].interval is not None
    assert fit.constants["s"].value == pytest.approx(100)
    assert fit.constants["d"].interval is None
    assert any("`d` has no interval: the data tie its value to `s`" in warning for warning in fit.warnings)
    found = gbspec.open_run(tmp_path / "run").profile("d")
    assert found.low is not None
    assert found.low < 10


@pytest.mark.parametrize(("r2", "lost"), [(0.5, False), (0.1, True), (None, True)])
def test_a_fit_that_follows_no_data_says_nothing_of_its_constants(tmp_path: Path, r2: float | None, lost: bool) -> None:
    """Widening the bounds, or giving the constant a value, would not mend a wrong minimum."""
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", "k = 0.5 in [0.1, 2]"))
    model = gbspec.load(tmp_path / "m.gb").model
    constants = {"k": ConstantRecord(0.5, 0.9, (0.1, 2.0), 0.5, (0.5,), None)}
    result = member(ChannelRecord(r2, 0.2), 2.0)
    found = said_of_constants(model, constants, [(0, "k", 2.0)], {0: result})
    assert any("not determined" in text for text in found) is not lost
    assert any("widen the bounds" in text for text in found) is not lost
    assert any("says nothing of where the constant lies" in text for text in found) is lost


def test_a_constant_that_alone_has_no_interval_is_told() -> None:
    known = {name: ConstantRecord(1.0, sd, None if sd is None else (0.5, 1.5), 1.0, (1.0,)) for name, sd in
             (("a", 0.1), ("b", None))}  # fmt: skip
    (text,) = unsettled(known, [], {})
    assert text.startswith("`b` has no interval: the fit has not come to rest there")
    assert not unsettled(known, [(0, "b", 0.0)], {})
    assert not unsettled({"b": known["b"]}, [], {})


def test_a_bound_is_told_where_the_likelihood_of_a_population_ended_at_it(tmp_path: Path) -> None:
    """Noise in proportion to the value: the constant part stops on its way to the bound, where nothing changes any
    more, and its linearised deviation there is thousands of times the value."""
    text = TEXT.replace("observe x", "learn a = 0.3 in [1e-4, 5]\nlearn b = 0.1 in [0.001, 1]\nobserve x noise ")
    (tmp_path / "m.gb").write_text(text.rstrip() + " normal(sqrt(a^2 + (b*y)^2))\n")
    random, t = np.random.default_rng(2), np.arange(0.1, 3.0, 0.1)
    x = np.exp(-t) * (1 + 0.05 * random.standard_normal(len(t)))
    (tmp_path / "d.csv").write_text("t,x\n" + "".join(f"{a},{b}\n" for a, b in zip(t, x, strict=True)))
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    assert fit.constants["a"].interval is None
    assert any("`a` ended at" in text and "its bound 0.0001" in text for text in fit.warnings)
    assert not any("not determined" in text for text in fit.warnings)
    sd = fit.constants["b"].sd
    assert sd is not None, "that with `a` at its bound"
    assert sd == pytest.approx(fit.constants["b"].value / (2 * len(t)) ** 0.5, rel=0.02)


def test_a_fit_whose_constants_ended_at_bounds_is_at_rest(tmp_path: Path) -> None:
    """It is at its minimum within the bounds; narrower ones, or more effort, would not help."""
    (tmp_path / "m.gb").write_text(TEXT.replace("k = 1 in [0, 2]", "k = 0.5 in [0.01, 1]"))
    random, t = np.random.default_rng(2), np.arange(0.1, 3.0, 0.1)
    x = np.exp(-2 * t) * (1 + 0.01 * random.standard_normal(len(t)))
    (tmp_path / "d.csv").write_text("t,x\n" + "".join(f"{a},{b}\n" for a, b in zip(t, x, strict=True)))
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run").run.fit
    assert fit.constants["k"].value == pytest.approx(1.0, rel=1e-6)
    assert any("`k` ended at its bound 1" in text for text in fit.warnings)
    assert any("autocorrelated" in text for text in fit.warnings)
    assert any("follow `x` worse" in text and "what may help: wider bounds of `k`" in text for text in fit.warnings)
    assert not any("come to rest" in text or "narrower" in text for text in fit.warnings)


def test_a_disturbance_is_tied_to_the_rate_at_its_bound_and_the_mean_is_not(tmp_path: Path) -> None:
    """Of values without memory the likelihood tells the mean, and s^2/theta."""
    text = "model m\nstate X in [-5, 5] = 0\nlearn theta = 1 in [0.01, 10]\nlearn mu = 0.5 in [-5, 5]\n"
    text += "learn s = 0.5 in [0, 20]\nX' = theta*(mu - X)\ndiffusion X = s\nobserve X noise normal(0.01)\n"
    (tmp_path / "m.gb").write_text(text)
    x = 1 + 0.5 * np.random.default_rng(1).standard_normal(40)
    x[1::2] -= 0.3  # less than no memory
    (tmp_path / "d.csv").write_text("t,X\n" + "".join(f"{t},{value}\n" for t, value in enumerate(x)))
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    assert fit.constants["theta"].interval is None
    low, high = fit.constants["mu"].interval or (np.nan, np.nan)
    assert high - low == pytest.approx(2 * 1.645 * x.std(ddof=1) / 40**0.5, rel=0.05)
    assert fit.constants["s"].interval is None
    (said,) = [text for text in fit.warnings if "`s`" in text]
    assert "the data tie its value to `theta`" in said
    assert not any("not determined" in text for text in fit.warnings)


@pytest.mark.parametrize(
    ("declared", "value", "sd", "said"),
    [
        ("0.05 in [0.001, 2]", 0.00108, math.nan, True),
        ("0.05 in [0.001, 2]", 0.0013, math.nan, False),
        ("0.05 in [0.001, 2]", 0.00108, 1e-5, False),  # the standard deviation tells it from the bound
        ("0.00101 in [0.001, 2]", 0.00108, math.nan, False),  # it began there
        ("50 in [0, 100]", 0.5, math.nan, False),  # nothing special on a linear scale
        ("50 in [0, 100]", 0.05, math.nan, True),
    ],
)
def test_constants_near_their_bounds_in_fits_that_did_not_rest(
    declared: str, value: float, sd: float, said: bool
) -> None:
    model = model_of(f"model m\nstate x = 1\nlearn k = {declared}\nx' = -k*x\nobserve x\n")
    result = MemberResult(0, 0.1, 0.1, {}, {}, {}, {"k": value}, {"k": sd}, 1.0, [], np.ones((1, 1)), ["1"])
    found = near_bounds(model, [], {0: result})
    assert len(found) == said and all("`k` ended at" in text and "near its bound" in text for text in found)
    assert not near_bounds(model, [(0, "k", 0.001)], {0: result}), "that is told"


COUNTS = """\
model m
state x in [0, 2000]
learn r = 1 in [0, 2]
learn k = 10 in [0.1, UPPER]
x' = -r*x
initial x = 1
observe x noise NOISE
"""


@pytest.mark.parametrize(
    ("noise", "upper", "sd", "said"),
    [
        (
            "negative_binomial(k)",
            1e4,
            3.5,
            "the counts vary no more than Poisson's; `noise poisson` says the same",
        ),
        ("negative_binomial(k)", 1e4, 1e3, "the counts vary less than this bound says: widen it, or write `noise"),
        ("student(0.1, k)", 100, 0.1, "there are no more outliers than under a normal noise; `noise normal(…)` of the"),
        (
            "student(0.1, k)",
            10,
            0.1,
            "there are fewer outliers than this bound says: widen it, or write `noise normal(…)",
        ),
    ],
)
def test_a_noise_at_its_limit_needs_no_wider_bound(
    tmp_path: Path, noise: str, upper: float, sd: float, said: str
) -> None:
    (tmp_path / "m.gb").write_text(COUNTS.replace("NOISE", noise).replace("UPPER", f"{upper:g}"))
    model = gbspec.load(tmp_path / "m.gb").model
    result = member(ChannelRecord(0.9, 0.1, "the mean"), 1.0)
    result.constants, result.noise = {"r": 1.0, "k": upper}, {"x": sd}
    (told,) = said_of_constants(model, {}, [(0, "k", upper)], {0: result})
    assert f"`k` ended at its bound {upper:g}; {said}" in told and "plausible" not in told
    (low,) = said_of_constants(model, {}, [(0, "k", 0.1)], {0: result})
    assert "widen the bounds if values beyond it are plausible" in low


@pytest.mark.parametrize("start", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_slopes_in_natural_units_are_known_beside_bounds(start: float, value: float) -> None:
    maps = Bijections((Bijection(0.0, 1.0, start),))
    u = maps.from_natural(np.array([value]))
    beside = maps.inside(u)
    assert (maps.derivative(beside) > 0).all()
    assert maps.to_natural(torch.from_numpy(beside)).numpy() == pytest.approx([value], abs=2e-6)


def test_a_constant_at_its_bound_beside_the_stated_noise_is_believed(tmp_path: Path) -> None:
    """The likeliest rate is 0, and the residuals are the stated noise: a line is nearer by two numbers for it."""
    x = (1.0078, 0.9728, 0.8382, 1.1782, 1.0853, 1.0854, 1.1238, 1.0449)
    text = "model d\ntime t from 0\nstate x\nlearn k = 0.3 in [0, 2]\nx' = -k*x\ninitial x = 1\nobserve x"
    rows = "".join(f"{0.25 + 0.4 * i},{value}\n" for i, value in enumerate(x))
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    (tmp_path / "m.gb").write_text(text + " noise normal(0.1)\n")
    run = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run
    assert run.fit.warnings == ("member 0: `k` ended at its bound 0; the data do not need it",)
    channels = run.fit.members[0].channels
    assert channels is not None and channels["x"].as_stated
    assert how_followed(channels["x"].r2 or 0.0, [channels["x"]]) == "in part"
    (tmp_path / "m.gb").write_text(text + " noise normal(0.02)\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "other", effort="low").run.fit
    assert any("worse than a straight line" in one for one in fit.warnings), (
        "noise of 0.02 does not make such residuals"
    )
