"""An unstable system under control: whole solutions cannot follow it, and the summary says what can be done."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

MAGNET = """\
model magnet "A ball that a controlled current holds"
time t : s
input i held
state x in [0, 0.03]
state v in [-1, 1]
learn c in [1e-6, 1]
x' = v
v' = 9.81 - c*i^2/x^2
observe x
"""


def rows() -> list[tuple[float, float, float]]:
    """Times, currents that a controller of position and speed gives, and measured positions."""
    rng, dt, fine = np.random.default_rng(0), 0.004, 20
    x, v, out = 0.010, 0.0, []
    for k in range(400):
        wanted = 0.010 + 0.001 * np.sin(2.1 * k * dt * 5)
        i = 0.010 * np.sqrt(9.81 / 1e-3) + 250 * (x - wanted) + 5 * v
        out.append((k * dt, i, x + 2e-5 * rng.normal()))
        for _ in range(fine):
            v += dt / fine * (9.81 - 1e-3 * i**2 / x**2)
            x += dt / fine * v
    return out


@pytest.mark.usefixtures("quick_fit")
def test_pieces_are_advised_and_can_be_fitted(tmp_path: Path) -> None:
    (tmp_path / "magnet.gb").write_text(MAGNET)
    model, data = gbspec.load(tmp_path / "magnet.gb"), rows()
    (tmp_path / "whole.csv").write_text("\n".join(["t,i,x", *(f"{t},{i},{x}" for t, i, x in data)]) + "\n")
    cut = [f"{k // 25},{t},{i},{x}" for k, (t, i, x) in enumerate(data)]
    (tmp_path / "cut.csv").write_text("\n".join(["trajectory,t,i,x", *cut]) + "\n")
    whole = model.train(tmp_path / "whole.csv", tmp_path / "whole", effort="low").run.fit
    (said,) = [text for text in whole.warnings if "the equations are unstable at the data" in text]
    assert "pieces no longer than 0.1" in said
    pieces = model.train(tmp_path / "cut.csv", tmp_path / "pieces", effort="low").run.fit
    assert abs(pieces.constants["c"].value / 1e-3 - 1) < 0.02
    assert not any("unstable at the data" in text for text in pieces.warnings)
