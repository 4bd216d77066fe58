"""Profiles of constants whose estimates are at a bound, against the deviance in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

import gbspec

pytestmark = pytest.mark.usefixtures("quick_fits")

T = np.linspace(0.25, 3.0, 8)
NOISE = 0.05 * np.random.default_rng(1).standard_normal(8)
MODEL = "model grows\ntime t from 0\nstate x\nlearn k = {}\nx' = {}k*x\ninitial x = 1\nobserve x\n"


@pytest.mark.parametrize(
    ("learned", "sign", "growth"),
    [
        ("0.3 in [0, 2]", "-", 0.02),
        ("0.3 in [0, 10000]", "-", 0.2),
        ("0.3 in [1e-6, 10]", "-", 0.2),
        ("0.3 >= 0", "-", 0.02),
        ("-0.3 in [-5, 0]", "", 0.02),
    ],
)
def test_the_interval_beside_a_bound_ends_where_the_deviance_does(
    tmp_path: Path, learned: str, sign: str, growth: float
) -> None:
    """What grows is fitted by a decay, whose rate is then at its bound."""
    y = np.exp(growth * T) + NOISE
    (tmp_path / "grows.gb").write_text(MODEL.format(learned, sign))
    (tmp_path / "grows.csv").write_text("t,x\n" + "".join(f"{a},{b}\n" for a, b in zip(T, y, strict=True)))
    gbspec.train(tmp_path / "grows.gb", tmp_path / "grows.csv", tmp_path / "run", effort="low")
    found = gbspec.open_run(tmp_path / "run").profile("k")

    def squares(rate: float) -> float:
        return float(np.sum((y - np.exp(-rate * T)) ** 2))

    assert found.noise is not None
    variance = found.noise**2 * np.var(y)
    end = brentq(lambda rate: (squares(rate) - squares(0.0)) / variance - found.threshold, 0.0, 5.0)
    bound, other = (found.low, found.high) if sign else (found.high, found.low)
    assert bound == pytest.approx(0.0, abs=1e-6)
    assert other is not None
    assert abs(other) == pytest.approx(end, rel=0.1)
    assert not [note for note in found.notes if "far apart" in note]
