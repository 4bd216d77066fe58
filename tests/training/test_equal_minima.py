"""Constants that fit equally well as others: the summary names them, and the declared start chooses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

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
