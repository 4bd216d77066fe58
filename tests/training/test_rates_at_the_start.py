"""Rates that are measured where trajectories start, and nowhere else: they tell of the dynamics by themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.data.table import read_frame
from gbspec.diagnostics import Findings, UserError
from gbspec.ir import informative_at_start
from tests.texts import model_of

ENZYME = """
model enzyme
time t
condition c in [0, 2]
state S in [0, 2]
learn V = 1 in [0.1, 10]
learn K = 0.5 in [0.01, 5]
S' = -V*S/(K + S)
initial S = c
observe v = -S'
"""
LEARNED = """
model learned
time t
state x in [0, 4]
unknown f(x)
x' = f(x)
observe x
observe r = x'
"""
STARTS = "model starts\ntime t\nstate x = 1 in [0, 4]\nlearn a = 1 in [0.1, 5]\nx' = -a*x\nobserve x\n"


def rates(at: float = 0.0) -> dict[str, object]:
    conc = np.repeat([0.05, 0.1, 0.2, 0.5, 1.0, 2.0], 2)
    noise = np.random.default_rng(3).normal(size=12) * 0.02
    rows = {"trajectory": np.arange(12), "t": np.full(12, at), "c": conc}
    return rows | {"v": 2.0 * conc / (0.3 + conc) + noise}


def fitted(text: str, rows: dict[str, object], path: Path) -> gbspec.FittedRun:
    path.with_suffix(".gb").write_text(text)
    return gbspec.load(path.with_suffix(".gb")).train(rows, path, effort="low")


@pytest.mark.usefixtures("quick_fits")
def test_rates_at_the_start_determine_their_constants(tmp_path: Path) -> None:
    here, later = (fitted(ENZYME, rates(at), tmp_path / f"run{at}") for at in (0.0, 1e-6))
    for name, truth in (("V", 2.0), ("K", 0.3)):
        found, other = (run.run.fit.constants[name] for run in (here, later))
        assert found.value == pytest.approx(truth, rel=0.1)
        assert found.value == pytest.approx(other.value, rel=1e-3)
        assert found.interval is not None and other.interval is not None
        assert found.interval == pytest.approx(other.interval, rel=1e-2)
    error = here.validate(rates())
    assert error.channels["v"].r2 > 0.99


@pytest.mark.usefixtures("quick_fits")
def test_states_and_rates_at_one_time_determine_a_function(tmp_path: Path) -> None:
    x = np.linspace(0.2, 3.8, 15)
    run = fitted(LEARNED, {"trajectory": np.arange(15), "t": np.zeros(15), "x": x, "r": x * (3 - x)}, tmp_path / "run")
    found = run.function("f", x)["value"].to_numpy()
    assert np.abs(found - x * (3 - x)).max() < 0.3


def test_single_times_that_tell_nothing_are_pointed_out() -> None:
    for text, rows, told in (
        (ENZYME, rates(), False),
        (ENZYME.replace("initial S = c\n", ""), rates(), True),
        (LEARNED, {"t": [0.0], "x": [1.0], "r": [0.5]}, False),
        (LEARNED, {"t": [0.0], "x": [None], "r": [0.5]}, True),
        (STARTS.replace(" = 1", ""), {"t": [0.0], "x": [1.0]}, True),
    ):
        findings = Findings()
        read_frame(rows, model_of(text), findings)
        assert [one.code for one in findings] == ["GB727"] * told


@pytest.mark.parametrize(
    ("begins", "remedy"), [("time t", "before their first rows: `time t from 0`"), ("time t from 0", "start at t = 0")]
)
def test_only_values_of_starts_are_refused_with_the_reason(begins: str, remedy: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        fitted(STARTS.replace("time t", begins), {"t": [0.0, 1.0], "x": [1.1, None]}, tmp_path / "run")
    (error,) = caught.value.diagnostics
    assert error.code == "GB856" and "neither a rate" in error.message and remedy in error.help


def test_what_tells_at_the_start() -> None:
    text = """
model m
time t
state x = 1 in [0, 2]
state y in [0, 2]
learn k = 1 in [0, 2]
unknown f(x)
let sum = x + y
let flow = k*x
x' = f(x)
y' = -flow
initial y = 2*k
observe a = x
observe b = sum
observe c = flow
observe d = x'
observe e = f(x) + 1
"""
    assert informative_at_start(model_of(text)) == (False, True, True, True, True)
