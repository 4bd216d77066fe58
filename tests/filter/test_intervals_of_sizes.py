"""Standard deviations of a fit with disturbances whose innovations are not independent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import read
from gbspec.diagnostics import Findings
from gbspec.training import train
from tests.filter.test_fits import FAST, model_in

RETURNING = """model m
time t
state x in [-20, 20]
learn k = 0.5 in [0.01, 5]
learn s = 1 in [0, 10]
x' = -k*x
diffusion x = s
observe x noise normal(0.001)
"""


def test_sizes_keep_the_deviations_of_the_likelihood_where_innovations_are_correlated(tmp_path: Path) -> None:
    """They were widened by the factor of a mean, 2 or more here, while the summary called intervals too narrow."""
    rng, x = np.random.default_rng(4), np.zeros(300)
    pushed = 0.0
    for i in range(1, len(x)):
        pushed = 0.7 * pushed + rng.standard_normal()
        x[i] = 0.8 * x[i - 1] + pushed
    model = model_in(tmp_path, RETURNING)
    rows = "\n".join(f"{i},{value}" for i, value in enumerate(x))
    (tmp_path / "d.csv").write_text(f"t,x\n{rows}\n", encoding="utf-8")
    run = train(model, read(tmp_path / "d.csv", model, Findings()), FAST, tmp_path / "run")
    assert any("innovations of `x`" in text and "may be too narrow" in text for text in run.fit.warnings)
    s = run.fit.constants["s"]
    # The size of 299 increments has the deviation s / sqrt(2 n), and somewhat more beside the rate.
    assert s.sd == pytest.approx(s.value / np.sqrt(2 * 299), rel=0.15)
