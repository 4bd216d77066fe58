"""Intervals of few values: the noise that is estimated from them is not known either (Student 1908)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import f, t

import gbspec
from gbspec.analysis.prediction.noise import interval
from gbspec.runs import quantile

BOD = """\
model bod
state y in [0, 40]
learn A = 20 in [1, 100]
learn k = 0.3 in [0.01, 5]
y' = k*(A - y)
initial y = 0
observe y
"""


@pytest.mark.parametrize("freedom", [1.0, 4.0, 37.5, 1e6])
def test_the_quantile_is_that_of_student(freedom: float) -> None:
    assert quantile(freedom) == pytest.approx(t.ppf(0.95, freedom))
    assert quantile(freedom) ** 2 == pytest.approx(f.ppf(0.9, 1, freedom))
    assert quantile(None) == pytest.approx(quantile(1e9))


def test_few_values_have_intervals_by_student(tmp_path: Path) -> None:
    """Six values of biochemical oxygen demand and two constants (Bates and Watts 1988, A 1.4)."""
    (tmp_path / "m.gb").write_text(BOD)
    (tmp_path / "d.csv").write_text("t,y\n1,8.3\n2,10.3\n3,19\n4,16\n5,15.6\n7,19.8\n")
    gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run")
    run = gbspec.open_run(tmp_path / "run")
    fit, wide = run.run.fit, t.ppf(0.95, 4)
    assert fit.members[0].freedom == pytest.approx(4, abs=0.1)
    low, high = fit.constants["k"].interval or (np.nan, np.nan)
    sd = fit.constants["k"].sd
    assert sd is not None
    width = [np.log(x / (1 - x)) for x in ((end - 0.01) / 4.99 for end in (low, high))]
    place = (fit.constants["k"].value - 0.01) / 4.99
    assert width[1] - width[0] == pytest.approx(2 * wide * sd / (4.99 * place * (1 - place)), rel=0.02)
    assert run.profile("A", points=2).threshold == pytest.approx(wide**2, rel=0.02)
    found = run.predict(tmp_path / "d.csv").items[0]
    ends = interval(found.mean, found.sd, found.in_logarithms, wide)
    assert np.allclose(found.high, ends[1], rtol=0.01)
    before = replace(fit, members=tuple(replace(one, freedom=None) for one in fit.members))
    assert before.quantile == pytest.approx(1.6449, abs=1e-4), "older runs do not have it"
