"""Constants that fit equally well as others: the summary names them, and the declared start chooses."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import gbspec
from gbspec.runs import ChannelRecord, SearchRecord, StageRecord, last_search
from gbspec.training import Effort
from gbspec.training.runs.minima import found_once
from gbspec.training.runs.summary import MemberResult

pytestmark = pytest.mark.usefixtures("quick_fits")

ORAL = """\
model oral
time t : h
state gut
state cent
dose gut
learn ka {} in [0.02, 20]
learn ke in [0.01, 10]
learn V in [1, 300]
gut' = -ka*gut
cent' = ka*gut - ke*cent
initial gut = 0
initial cent = 0
observe c = cent/V
"""


@pytest.mark.parametrize(("start", "ka"), [("= 1", 0.9), ("= 0.1", 0.12)])
def test_rates_that_may_be_exchanged_are_both_named(tmp_path: Path, start: str, ka: float) -> None:
    rng, t = np.random.default_rng(1), np.arange(0.0, 25.0, 1.0)
    c = 320 / 30 * 0.9 / 0.78 * (np.exp(-0.12 * t) - np.exp(-0.9 * t)) * (1 + 0.03 * rng.normal(size=25))
    rows = [f"{a},{'' if i == 0 else b},{320 if i == 0 else ''}" for i, (a, b) in enumerate(zip(t, c, strict=True))]
    (tmp_path / "oral.csv").write_text("\n".join(["t,c,dose_gut", *rows]) + "\n")
    (tmp_path / "oral.gb").write_text(ORAL.format(start))
    fit = gbspec.load(tmp_path / "oral.gb").train(tmp_path / "oral.csv", tmp_path / "run").run.fit
    assert fit.constants["ka"].value == pytest.approx(ka, rel=0.1)
    (warning,) = [text for text in fit.warnings if "other constants fit the data equally well" in text]
    assert ("ka 0.12" in warning) is (ka == 0.9)


VIRUS = """\
model virus
time t : day from 0
state T
state VI
state VN
const K = 0.00429
learn c : 1/day = 1 in [0.1, 20]
learn delta : 1/day = 0.3 in [0.05, 5]
learn V0 = 1e6 in [1e5, 1e7]
{}
T' = K*VI - delta*T
VI' = -c*VI
VN' = 480*delta*T - c*VN
initial VI = V0
initial T = K*V0/delta
initial VN = 0
observe V = VI + VN noise lognormal({})
"""
RNA = {0: 1022, 0.083: 1079, 0.166: 2148, 0.25: 1043, 0.5: 2170, 0.75: 1538, 1: 3098, 1.25: 2262, 1.5: 1315, 1.75: 1200}
RNA |= {2: 980, 3: 710, 4: 500, 5: 280, 6: 170, 7: 89}
"""Thousands of copies of RNA in a mL of plasma of patient 105 of Perelson et al. (Science 1996)."""


@pytest.mark.parametrize(
    ("learned", "noise", "effort"),
    [("learn s = 0.3 > 0", "s", "low"), ("learn s = 0.3 > 0", "s", "normal"), ("", "0.3", "normal")],
)
def test_a_minimum_that_is_hardly_worse_is_named(tmp_path: Path, learned: str, noise: str, effort: Effort) -> None:
    """For every delta above 3 -2 log likelihood is 0.90 less than in the minimum at 0.626 that most starts lead to."""
    (tmp_path / "m.gb").write_text(VIRUS.format(learned, noise))
    (tmp_path / "d.csv").write_text("t,V\n" + "".join(f"{t},{1000 * value}\n" for t, value in RNA.items()))
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort=effort).run.fit
    if learned:
        assert fit.population is not None
        assert fit.population.minus2ll == pytest.approx(440.937, abs=0.01)
        assert any("`c` has no interval" in text and "`gbspec profile`" in text for text in fit.warnings)
    assert fit.constants["c"].value == pytest.approx(0.793, abs=0.002)
    (warning,) = [text for text in fit.warnings if "other constants fit the data equally well" in text]
    assert "c 1.34, delta 0.626, V0 1.31e+06 (-2 log likelihood higher by 0.9)" in warning


def test_a_constant_beside_another_one_at_its_bound_has_the_interval_of_its_profile(tmp_path: Path) -> None:
    """With delta at its bound c seems to be known to 7 %, and it rises as delta goes inside of it. Its deviance rises
    to 2.2 at 0.95, falls to 1 at 1.34 and passes 2.71 near 1.75: six values were used up at 0.96."""
    (tmp_path / "m.gb").write_text(VIRUS.format("", "0.3"))
    (tmp_path / "d.csv").write_text("t,V\n" + "".join(f"{t},{1000 * value}\n" for t, value in RNA.items()))
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run").run.fit
    assert fit.constants["c"].interval is None and fit.constants["V0"].interval is not None
    (warning,) = [text for text in fit.warnings if "`c` has no interval" in text]
    assert "to `delta`, which ended at a bound" in warning and "would be 0.7362 to 0.8552" in warning
    found = gbspec.open_run(tmp_path / "run").profile("c")
    assert found.low == pytest.approx(0.735, abs=0.005)
    assert found.high == pytest.approx(1.75, abs=0.05)


FORMULATIONS = """\
model formulations
time t : h from 0
condition form in {a, b}
state gut
state c
learn ka : 1/h = 0.5 in [0.02, 20]
learn ke : 1/h = 0.2 in [0.01, 5]
learn D = 3 in [0.2, 50]
learn F in [0.2, 5] = 1
gut' = -ka*gut
c' = ka*gut - ke*c
initial gut = D*if(form == b, F, 1)
initial c = 0
observe conc = c noise lognormal(0.3)
"""
CONCENTRATIONS = """1.08 1.99 1.46 1.21; 1.48 2.5 2.62 1.95; 1.19 2.1 1.21 .96; .62 .88 .68 .48; 1.22 1.91 1.36 .9
.65 1.52 1.32 .95; .6 1.1 1.03 .61; .32 2.12 1.48 1.09; .55 1 .82 .52; 1.48 .9 .75 .44"""
"""Tetracycline in two formulations at 1, 2, 3 and 6 h in five volunteers (Pinheiro and Bates 2000)."""


def test_a_step_that_is_too_long_makes_no_equal_minimum(tmp_path: Path) -> None:
    """Within one step of an hour, an absorption rate of 13.6/h is far beyond the stability of the solver."""
    rows = ["trajectory,t,conc,form"]
    for j, text in enumerate(CONCENTRATIONS.replace("\n", ";").split(";")):
        rows += [f"{j},{t},{one},{'ab'[j % 2]}" for t, one in zip((1, 2, 3, 6), text.split(), strict=True)]
    (tmp_path / "m.gb").write_text(FORMULATIONS)
    (tmp_path / "d.csv").write_text("\n".join(rows) + "\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    assert fit.constants["ka"].value == pytest.approx(fit.constants["ke"].value, rel=0.05)
    assert not any("other constants" in text for text in fit.warnings)


ONCE = SearchRecord(64, 1)


def searched(
    search: SearchRecord | None, loss: float = 0.1, notes: tuple[str, ...] = (), horizons: bool = False
) -> MemberResult:
    stages = [StageRecord("search", 64, loss, 1.0, search=search)]
    stages += [StageRecord("growing horizons", 9, loss, 1.0)] if horizons else []
    channels = {"x": ChannelRecord(0.9, 0.2, values=200)}
    found = SimpleNamespace(stages=stages, notes=notes, loss=loss, finished=True, channels=channels, objective=None)
    return cast(MemberResult, found)


@pytest.mark.parametrize(
    ("result", "said"),
    [
        (searched(ONCE), True),
        (searched(SearchRecord(64, 1, 20)), True),
        (searched(SearchRecord(64, 1, 21)), False),
        (searched(SearchRecord(64, 1, -1)), True),
        (searched(SearchRecord(64, 2)), False),
        (searched(SearchRecord(8, 1, 1)), True),
        (searched(None), False),
        (searched(ONCE, 1e-9), False),
        (searched(ONCE, notes=("other constants fit the data equally well: …",)), False),
        (searched(ONCE, horizons=True), False),
    ],
)
def test_a_best_minimum_that_was_found_once_is_told(result: MemberResult, said: bool) -> None:
    found = found_once({0: result}, "normal")
    assert len(found) == said and not any("-1" in text for text in found)
    assert all("`--effort high`" in text and text.startswith("member 0: ") for text in found)
    assert all("`--effort" not in text for text in found_once({0: result}, "high"))


def test_members_that_agree_have_found_it_several_times() -> None:
    assert not found_once({0: searched(ONCE, 0.1), 1: searched(ONCE, 0.101)}, "normal")
    (said,) = found_once({0: searched(ONCE, 0.1), 1: searched(ONCE, 0.3)}, "normal")
    assert said.startswith("member 0: "), "of the worse one that is said already"


def test_a_fit_keeps_what_its_last_search_has_found(tmp_path: Path) -> None:
    assert str(SearchRecord(64, 1, -1)) == "64 improved, the best minimum found 1 time", "records of older versions"
    assert str(SearchRecord(64, 1, 3)) == "64 improved, the best minimum found 1 time (3 others near it)"
    first, last = (StageRecord("search", 8, 0.1, 1.0, search=one) for one in (ONCE, SearchRecord(8, 12, 9)))
    assert last_search([first, last, StageRecord("whole solutions", 3, 0.1, 1.0)]) == SearchRecord(8, 12, 9)
    assert last_search([]) is None
    (tmp_path / "m.gb").write_text("model m\nstate x = 1\nlearn k in [0.01, 10]\nx' = -k*x\nobserve x\n")
    rows = "".join(f"{t},{np.exp(-0.7 * t):.3f}\n" for t in np.arange(0.0, 4.0, 0.5))
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    found = last_search(fit.members[0].stages)
    assert found is not None and found.times >= 2, "kept in fit.json, from which this run was read"
