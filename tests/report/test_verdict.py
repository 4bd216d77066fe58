"""The verdict in words: what is good, what to doubt, what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gbspec.analysis.validation.metrics import ChannelErrors
from gbspec.analysis.validation.step_check import StepCheck
from gbspec.analysis.validation.validate import Validation
from gbspec.report.content import LearnedFunction, Slice
from gbspec.report.verdict import verdict
from gbspec.runs import ChannelRecord, ConstantRecord, DataRecord, FitRecord, MemberRecord
from gbspec.training.runs.verdict import verdicts
from tests.training.conftest import model_of

X = np.linspace(0.0, 1.0, 20)
BOUND = "member 0: `a5` ended at its bound 0.001; widen the bounds if values beyond it are plausible"
STEP = (
    "member 0: the learned right-hand side depends on its training step of 0.2: solutions with half the step differ. "
    "Train with a smaller `--max-step` before computing eigenvalues or bifurcations"
)


def run(*warnings: str, held: float | None = 0.99, interval: tuple[float, float] | None = (0.98, 1.02)) -> Any:
    channels = {"x": ChannelRecord(0.99, 0.4, "the mean", held)}
    constants = {"k": ConstantRecord(1.0, None, interval, 0.5, (1.0,))}
    members = (MemberRecord(0, 1.0, {}, 0.0, (), channels=channels),)
    fit = FitRecord("0", "m", DataRecord("", "", 3, 9, 9), {}, {}, constants, {}, members, warnings)
    nothing = SimpleNamespace(truth_constants=(), unknowns=(), states=(), conditions=(), inputs=(), constants=(),
                              learnables=(), channels=(), tables=(), intermediates=(),
                              algebraics=(), processes=(), time=SimpleNamespace(name="t", unit=None))  # fmt: skip
    given = {"fit": fit, "model": nothing, "numbers": (0,), "path": Path("run"), "innovations": None}
    return SimpleNamespace(**given, profiled=lambda name: None)


def found(r2: float = 0.99) -> Validation:
    return Validation("mean", {"x": ChannelErrors(9, 0.1, 0.1, 0.1, r2)}, (), StepCheck(1e-6, 1e-6, 0.1))


def function(*, half: float, far: bool = False) -> LearnedFunction:
    band = np.stack([X - half, X + half])
    piece = Slice("x", X, X[None], None, "", band=band, far=(X > 0.8) if far else np.zeros(20, dtype=bool))
    return LearnedFunction("f", ("x",), X[:, None], X[None], None, (piece,))


@pytest.mark.parametrize(("maximum", "relied"), [(False, False), (None, True)])
def test_a_likelihood_that_is_at_no_maximum_is_not_relied_on(maximum: bool | None, relied: bool) -> None:
    given = run()
    given.innovations = SimpleNamespace(maximum=maximum)
    said = verdict(given, found(), (), with_data=True)
    assert ("Do not rely on this fit: its likelihood is not at its maximum." not in said.headline) is relied


def test_a_good_fit_is_called_good() -> None:
    said = verdict(run(), found(), (function(half=0.02),), with_data=True)
    assert said.headline == "It follows the data."
    assert (said.doubt, said.do) == ((), ())
    good = " ".join(said.good)
    assert "Whole solutions follow `x`: R² 0.99 over 9 values; without a model, the mean reaches 0.4." in said.good
    for part in ("`k` ±2 %", "did not see", "`f` over `x`: the 90 % band is ±2 %", "Smaller steps"):
        assert part in good


@pytest.mark.parametrize(
    ("r2", "headline"),
    [(0.7, "in part"), (0.2, "Do not rely"), (-3.0, "Do not rely"), (float("nan"), "Do not rely")],
)
def test_a_bad_fit_is_called_bad(r2: float, headline: str) -> None:
    said = verdict(run(), found(r2), (), with_data=True)
    assert headline in said.headline
    assert any("`x`" in text for text in said.doubt)


def test_warnings_are_told_with_what_they_advise() -> None:
    said = verdict(run(BOUND, STEP), found(), (), with_data=True)
    assert said.headline == "It follows the data, with reservations."
    assert "`a5` ended at its bound 0.001." in said.doubt
    assert "Widen the bounds if values beyond it are plausible." in said.do
    assert said.do[1].startswith("Train with a smaller `--max-step`")


def test_no_warning_is_lost() -> None:
    """Whatever its words: one without advice stands as it is."""
    odd = "something: nobody foresaw; it has no remedy"
    assert verdict(run(odd), found(), (), with_data=True).doubt == ("Something: nobody foresaw; it has no remedy.",)


def test_what_is_uncertain_or_untried_is_doubted() -> None:
    said = verdict(run(held=None, interval=(0.1, 1.9)), found(), (function(half=0.4, far=True),), with_data=True)
    doubt = " ".join(said.doubt)
    for part in ("hardly determine `k`", "hardly determine `f` over `x`", "extrapolated", "fitted to"):
        assert part in doubt
    assert any("--holdout" in text for text in said.do)
    assert any("No interval is known for `k`" in text for text in verdict(run(interval=None), found(), (),
                                                                          with_data=True).doubt)  # fmt: skip


def test_without_data_nothing_is_judged() -> None:
    said = verdict(run(), Validation("mean", {}, (), StepCheck(None, None, 0.1)), (), with_data=False)
    assert said.headline.startswith("Without its data")
    assert any("was not found" in text for text in said.doubt)


@pytest.mark.parametrize(
    ("half", "said"), [(0.4, "±40 % of its range"), (0.999, "±100 % of"), (1.1, "more than 100 %")]
)
def test_a_function_that_is_hardly_determined_is_a_reservation(half: float, said: str) -> None:
    found_so = verdict(run(), found(), (function(half=half),), with_data=True)
    assert found_so.headline == "It follows the data, with reservations."
    (doubt,) = found_so.doubt
    assert doubt.startswith("The data hardly determine `f` over `x`") and said in doubt and "e+" not in doubt


def test_a_constant_that_is_hardly_determined_is_a_reservation() -> None:
    said = verdict(run(interval=(-1.0, 3.0)), found(), (), with_data=True)
    assert said.headline == "It follows the data, with reservations."
    assert any("hardly determine `k`" in text for text in said.doubt)


def test_a_small_doubt_is_no_reservation() -> None:
    said = verdict(run(held=None), found(), (), with_data=True)
    assert said.doubt and said.headline == "It follows the data."


def test_what_no_data_can_separate_is_a_doubt_with_advice() -> None:
    known = "`a` and `b` cannot be told apart by what is observed (GB401): they can change together; "
    said = verdict(run(known + "observe `y`; or accept it with `allow GB401 a`"), found(), (), with_data=True)
    assert said.headline == "It follows the data, with reservations."
    assert said.do == ("Observe `y`; or accept it with `allow GB401 a`.",)


def test_what_the_fit_warns_of_is_not_said_twice() -> None:
    """The warning of `train` and the errors on the data come from one definition, and are one doubt."""
    (warning,) = verdicts({"x": ChannelRecord(0.4, 0.1, "the mean")})
    said = verdict(run(f"member 0: {warning}"), found(0.4), (), with_data=True)
    assert said.headline.startswith("Do not rely")
    assert [text for text in said.doubt if "`x` badly" in text] == [
        "Whole solutions follow `x` badly: R² 0.4 over 9 values; without a model, the mean reaches 0.4."
    ]
    assert any("postulate" in text for text in said.do)
    alone = verdict(run(f"member 0: {warning}"), Validation("mean", {}, (), StepCheck(None, None)), (), with_data=False)
    assert any("they leave 60 % of the variance" in text for text in alone.doubt)


@pytest.mark.parametrize("r2", [0.3, 0.499, 0.5, 0.7])
def test_the_fit_and_the_report_agree(r2: float) -> None:
    warnings = verdicts({"x": ChannelRecord(r2, 0.0, "the mean")})
    headline = verdict(run(*warnings), found(r2), (), with_data=True).headline
    assert bool(warnings) == headline.startswith("Do not rely") == (r2 < 0.5)


def test_predictions_ahead_that_are_lost_are_told_with_what_to_do() -> None:
    """Its solutions are not what a fit with disturbances is judged by, and what may be the cause is no advice."""
    text = "model m\nstate x = 1\nlearn s = 1\nlearn r = 1\nx' = r*x\ndiffusion x = s\nobserve x\n"
    warnings = verdicts({"x": ChannelRecord(-0.24, 0.92, "the last value before", values=42)}, model_of(text))
    errors = {"x": ChannelErrors(9, 0.1, 0.1, 0.1, -0.24)}
    ahead = Validation("mean", errors, (), StepCheck(1e-6, 1e-6, 0.1), ahead={"1": errors})
    said = verdict(run(*warnings), ahead, (), with_data=True)
    assert said.headline == "Do not rely on this fit: its predictions do not follow the data."
    assert any(one.endswith("or the disturbances are not of this form.") for one in said.doubt)
    (advice,) = (one for one in said.do if "rely" in one)
    assert advice.startswith("Do not rely on this fit. What may help: smaller starts")


def test_a_small_share_beside_the_stated_noise_is_explained() -> None:
    given = run()
    (member,) = given.fit.members
    for r2, told in ((-0.05, True), (0.95, False)):
        record = ChannelRecord(r2, 0.0, "the mean", as_stated=True)
        given.fit = replace(given.fit, members=(replace(member, channels={"x": record}),))
        said = verdict(given, found(r2), (), with_data=True)
        assert any(one.endswith("; what is left is no larger than the stated noise.") for one in said.doubt) is told
        assert not said.headline.startswith("Do not rely")
