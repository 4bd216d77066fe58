"""Fits of models whose right-hand sides switch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data import Trajectories, Trajectory
from gbspec.passes import with_switches
from gbspec.training import TrainOptions, train
from gbspec.training.profile.likelihood import profile_constant
from gbspec.training.progress import Update
from gbspec.training.recipe.cutting import only_in_switches
from tests.switches.models import OVERFLOW, RELAY, SEVERAL
from tests.training.conftest import Recorder, model_of

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.usefixtures("quick_fits")

TANK = """model tank
time t from 0
state h in [0, 5]
learn rim = 1.2 in [0.5, 2]
learn q = 0.6 in [0.2, 0.95]
h' = 2 - if(h > rim, q, 0.2)*h
initial h = 0.2
observe h
"""
RIM, Q = 1.07, 0.8
KNOWN = TANK.replace("learn rim = 1.2 in [0.5, 2]\n", "").replace("rim", str(RIM))
FAST = TrainOptions(workers=1, effort="low", backend="native")


def filled(times: np.ndarray) -> Trajectories:
    """The exact level: it rises towards 10 up to the rim, then towards 2/Q, which is beyond it."""
    switch = -np.log((10 - RIM) / (10 - 0.2)) / 0.2
    before = 10 - 9.8 * np.exp(-0.2 * times)
    values = np.where(times < switch, before, 2 / Q - (2 / Q - RIM) * np.exp(-Q * (times - switch)))[:, None]
    item = Trajectory("1", 0.0, times, values, np.ones_like(values), np.full_like(values, np.nan), np.zeros(0))
    return Trajectories((item,), ("h",))


DATA = filled(np.linspace(0.15, 3.0, 14))


def test_steps_are_cut_where_a_threshold_is_learned(tmp_path: Path) -> None:
    run = train(model_of(TANK), DATA, FAST, tmp_path / "run")
    stage = next(stage for stage in run.fit.members[0].stages if stage.name == "cut steps")
    assert stage.remark is not None and "`h - rim` changes its sign" in stage.remark and "`rim`" in stage.remark
    assert run.fit.constants["rim"].value == pytest.approx(RIM, rel=1e-5)
    assert run.fit.constants["q"].value == pytest.approx(Q, rel=1e-5)
    assert run.member().info["switches"]


class AtTheCut(Recorder):
    """Interrupts in the stage that continues with cut steps."""

    def update(self, update: Update) -> None:
        self.interrupt_after = len(self.updates) + 1 if update.stage == "cut steps" else None
        super().update(update)


def test_a_run_that_was_stopped_resumes_with_cut_steps_and_is_profiled_with_them(tmp_path: Path) -> None:
    whole = train(model_of(TANK), DATA, FAST, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(model_of(TANK), DATA, FAST, tmp_path / "cut", AtTheCut())
    resumed = train(model_of(TANK), DATA, replace(FAST, resume=True), tmp_path / "cut")
    assert {k: c.value for k, c in resumed.fit.constants.items()} == {
        k: c.value for k, c in whole.fit.constants.items()
    }
    found = profile_constant(whole, "rim", DATA, points=4)  # other steps would have their minimum elsewhere
    assert found.low is not None and found.high is not None
    assert RIM - 1e-5 < found.low < found.high < RIM + 1e-5


def test_a_resumed_run_gives_the_same_reason_for_cut_steps(tmp_path: Path) -> None:
    known = model_of(KNOWN)
    with pytest.raises(KeyboardInterrupt):
        train(known, DATA, FAST, tmp_path / "run", AtTheCut())
    resumed = train(known, DATA, replace(FAST, resume=True), tmp_path / "run")
    (stage,) = [stage for stage in resumed.fit.members[0].stages if stage.name == "cut steps"]
    assert stage.remark is not None and stage.remark.endswith("other steps have no derivatives of the times of jumps")


@pytest.mark.parametrize(
    "balance",
    [
        "2 - 0.01*max(h, mod(t, 2)) - if(h > 1.07, q, 0.2)*h",
        "2 - q*if(h > 0, h/(1 + h), 0) - 0.01*delay(h, 1)\nhistory h = 0.2",
    ],
)
def test_derivatives_at_kinks_leave_nothing_out(tmp_path: Path, balance: str) -> None:
    text = KNOWN.replace(f"2 - if(h > {RIM}, q, 0.2)*h", balance)
    run = train(model_of(text), DATA, replace(FAST, epochs=1, method="lm", switches="on"), tmp_path / "run")
    assert any("switch" in said for said in run.fit.warnings)
    assert not [said for said in run.fit.warnings if "Derivatives leave out" in said]


def test_jumps_that_no_stage_reached_are_told(tmp_path: Path) -> None:
    known = model_of(KNOWN)
    run = train(known, DATA, replace(FAST, epochs=1, method="lm"), tmp_path / "run")
    (said,) = [text for text in run.fit.warnings if "where right-hand sides jump" in text]
    assert "has no stage `cut steps`" in said


def test_steps_stay_as_they_are_when_told_so(tmp_path: Path) -> None:
    run = train(model_of(TANK), DATA, replace(FAST, switches="off"), tmp_path / "run")
    assert "cut steps" not in [stage.name for stage in run.fit.members[0].stages]
    assert abs(run.fit.constants["rim"].value - RIM) > 1e-4 and "switches" not in run.member().info


def test_cutting_from_the_first_step(tmp_path: Path) -> None:
    run = train(model_of(TANK), DATA, replace(FAST, switches="on", max_step=0.15), tmp_path / "run")
    assert "cut steps" not in [stage.name for stage in run.fit.members[0].stages]
    assert run.fit.constants["rim"].value == pytest.approx(RIM, rel=1e-4)


def test_what_is_not_cut_is_told(tmp_path: Path) -> None:
    text = TANK.replace("state h", "state s[1..2] in [0, 2]\nstate h").replace("observe h", "s[i]' = -s[i]\nobserve h")
    text = text.replace("initial h", "initial s[i] = 1\ninitial h")
    run = train(model_of(text), DATA, replace(FAST, switches="on", epochs=1, method="lm"), tmp_path / "run")
    assert any("do not end where right-hand sides switch: the model has arrays" in text for text in run.fit.warnings)


def test_constants_that_only_conditions_know() -> None:
    found = {}
    for text in (OVERFLOW, RELAY, SEVERAL):
        model = model_of(text)
        cut = with_switches(model).model
        assert cut is not None
        found[model.name] = only_in_switches(model, cut)
    assert found == {"overflow": (), "relay": ("a",), "several": ()}


def test_what_switches_by_itself_is_no_switch() -> None:
    text = "model m\ntime t\nstate x\ninput u held\nx' = if(mod(t, 2) < 1, 1, 0) + max(u, 1) - x\nobserve x\n"
    assert with_switches(model_of(text)).model is None


def test_a_switch_that_an_unknown_function_decides_is_left_out() -> None:
    text = "model m\ntime t\nstate x\nunknown f(x) by mlp(4)\nx' = max(f, 0.1) - abs(x)\nobserve x\n"
    found = with_switches(model_of(text))
    assert found.model is not None and len(found.model.switches) == 1
    assert "an unknown function decides" in found.skipped[0]
