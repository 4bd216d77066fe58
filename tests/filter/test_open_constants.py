"""Constants of fits with disturbances that the curvature leaves open have the interval of the likelihood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import read
from gbspec.diagnostics import Findings
from gbspec.training import train
from tests.filter.test_fits import FAST, model_in

HEATED = """model heated
time t
input u held
state x in [-5, 5]
learn a = 0.1 in [0.001, 1]
learn s = 0.3 in [0.01, 5]
x' = -x + a*u
diffusion x = s
observe x noise normal(0.1)
"""


def test_an_interval_ends_where_the_likelihood_falls(tmp_path: Path) -> None:
    """On the scale of logarithms, 0.009 with a deviation of 0.08 may be anything: so it was called undetermined."""
    rng, x, lines, c = np.random.default_rng(1), 0.0, ["t,u,x"], np.exp(-0.2)
    for k in range(80):
        u = float(k // 10 % 2)
        lines.append(f"{k * 0.2:.1f},{u},{x + 0.1 * rng.standard_normal():.6f}")
        x = 0.06 * u + c * (x - 0.06 * u) + 0.3 * np.sqrt((1 - c * c) / 2) * rng.standard_normal()
    model = model_in(tmp_path, HEATED)
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    fit = train(model, read(tmp_path / "d.csv", model, Findings()), FAST, tmp_path / "run").fit
    a = fit.constants["a"]
    assert a.sd is not None and a.interval is not None
    # The readings are linear in it, so that the likelihood is nearly quadratic.
    assert a.interval == pytest.approx((0.001, a.value + 1.645 * a.sd), rel=0.1)
    assert not any("not determined" in text for text in fit.warnings), fit.warnings
    (said,) = [text for text in fit.warnings if "`a`" in text]
    assert "is that of the likelihood" in said and "leave `a` open down to its bound 0.001" in said
