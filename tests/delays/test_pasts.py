"""What a fit says where the data contradict the past that a model without `history` takes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import gbspec

MODEL = """model released "Release of what was there an hour ago"
time t
state z in [0, 2]
state x in [0, 2]
learn k = 1 in [0.1, 10]
z' = -z
x' = k*delay(z, 1) - 5*x
{history}
observe z
observe x
"""


@pytest.mark.parametrize("known", [False, True])
def test_a_past_that_was_not_constant_is_told(tmp_path: Path, known: bool) -> None:
    """z = exp(-t) also before the start, so that x = (2 e/4) exp(-t)."""
    rng, path, model = np.random.default_rng(0), tmp_path / "t.csv", tmp_path / "m.gb"
    rows = [
        f"{t},{math.exp(-t) * (1 + 0.002 * rng.normal())!r},{0.5 * math.exp(1 - t) * (1 + 0.002 * rng.normal())!r}"
        for t in np.arange(0, 6, 0.2).tolist()
    ]
    path.write_text("t,z,x\n" + "\n".join(rows) + "\n")
    model.write_text(MODEL.format(history="history z = exp(-t)" if known else ""))
    run = gbspec.train(model, path, tmp_path / "run", effort="low", threads=1).run
    told = [text for text in run.fit.warnings if "within the first delay" in text]
    if known:
        assert not told
        assert run.fit.constants["k"].value == pytest.approx(2, rel=0.01)
    else:
        text = next(text for text in told if "residuals of `x` within the first delay (1)" in text)
        assert "takes `z` to be constant before the start" in text
        assert "`history z = …`" in text
