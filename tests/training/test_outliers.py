"""Few values far from all others: the summary counts them, and says what to write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = "model decay\nstate x\nlearn k in [0.01, 10]\nx' = -k*x\nobserve x\n"


def table(wrong: float) -> dict[str, np.ndarray]:
    t = np.linspace(0, 4, 60)
    x = np.exp(-0.7 * t) + 0.01 * np.random.default_rng(2).normal(size=60)
    x[[20, 41]] += wrong
    return {"t": t, "x": x}


@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_outliers_are_counted(tmp_path: Path, wrong: float) -> None:
    (tmp_path / "decay.gb").write_text(DECAY)
    fit = gbspec.load(tmp_path / "decay.gb").train(table(wrong), tmp_path / "run", effort="low").run.fit
    said = [text for text in fit.warnings if "far from all others" in text]
    assert len(said) == (wrong > 0) and all("2 of 60 residuals of `x`" in text for text in said)
    assert (fit.members[0].channels or {})["x"].outliers == (2 if wrong else None)


def test_what_is_offered_can_be_fitted(tmp_path: Path) -> None:
    (tmp_path / "decay.gb").write_text(
        DECAY.replace("observe x", "learn s_x = 0.02 > 0\nobserve x noise student(s_x, 4)")
    )
    fit = gbspec.load(tmp_path / "decay.gb").train(table(0.4), tmp_path / "run", effort="low").run.fit
    assert fit.constants["k"].value == pytest.approx(0.7, rel=0.02)
    assert not any("far from all others" in text for text in fit.warnings)
