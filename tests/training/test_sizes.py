"""States whose size nothing declares: it follows from what channels show of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

pytestmark = pytest.mark.usefixtures("quick_fits")

CHAIN = """\
model chain "Two nuclides of which only activities are measured"
time t : s
state A
state B
learn la in [1e-8, 1e-3]
learn lb in [1e-8, 1e-3]
A' = -la*A
B' = la*A - lb*B
observe cA = 12*la*A
observe cB = 21*lb*B
"""


def counts(first: float) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    t = 1.5e5 + np.sort(rng.uniform(0, 9e5, 40)).round()
    la, lb, s = 2.9e-6, 3.2e-5, t - t[0]
    a = first * np.exp(-la * s)
    b = 0.01 * first * np.exp(-lb * s) + first * la / (lb - la) * (np.exp(-la * s) - np.exp(-lb * s))
    noise = 1 + 0.005 * rng.normal(size=(2, 40))
    return {"t": t, "cA": 12 * la * a * noise[0], "cB": 21 * lb * b * noise[1]}


def test_starts_of_any_size_are_found_where_no_range_says_it(tmp_path: Path) -> None:
    (tmp_path / "chain.gb").write_text(CHAIN)
    run = gbspec.load(tmp_path / "chain.gb").train(counts(8e9), tmp_path / "run", effort="low").run
    found = {name: record.value for name, record in run.fit.constants.items()}
    assert abs(found["la"] / 2.9e-6 - 1) < 0.02 and abs(found["lb"] / 3.2e-5 - 1) < 0.05
    assert all((channel.r2 or 0.0) > 0.999 for channel in (run.fit.members[0].channels or {}).values())
    assert not any("ended at its bound" in warning for warning in run.fit.warnings)
