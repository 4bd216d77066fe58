"""Disturbances that reach below zero where the noise is log-normal are told, with the statement that does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

LEVEL = """model level
learn k = 1 in [0.01, 5]
learn s = 0.3 in [0.001, 5]
state x in [0, 20]
x' = k*(2 - x)
diffusion x = {size}
observe x noise lognormal(0.1)
"""


@pytest.mark.parametrize(("size", "told"), [("s", True), ("s*x", False)])
def test_a_spread_below_zero_is_told(tmp_path: Path, size: str, told: bool) -> None:
    random, x, rows = np.random.default_rng(2), 2.0, ["t,x"]
    for i in range(40):
        rows.append(f"{i / 2},{x * np.exp(0.1 * random.standard_normal()):.4f}")
        for _ in range(50):
            x = max(x + (2 - x) * 0.01 + 0.13 * random.standard_normal(), 0.05)
    (tmp_path / "m.gb").write_text(LEVEL.format(size=size))
    (tmp_path / "d.csv").write_text("\n".join(rows) + "\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    said = [text for text in fit.warnings if "let `x` reach zero from one row to the next" in text]
    assert bool(said) == told, fit.warnings
    if told:
        assert "of 39 rows" in said[0] and "`diffusion x = s*x`" in said[0]
