"""A fit with disturbances is no worse than the one without them, however large these are to begin with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import read
from gbspec.diagnostics import Findings
from gbspec.runs import Run
from gbspec.training import train
from gbspec.training.optimise.near_none import near_none
from tests.filter.conftest import WITH_NETWORK, engine_of, table
from tests.filter.test_fits import FAST, model_in

GROWTH = """model growth
time t
state I in [0, 0.01]
learn I0 = 1e-7 in [1e-12, 1e-5]
learn r = 0.2 in [0.01, 1]
{}
I' = r*I
diffusion I = s
initial I = I0
observe I noise lognormal(0.3)
"""


def fitted(folder: Path, size: str) -> Run:
    """The fit to exponential growth that nothing disturbs, over three orders of magnitude."""
    rng, times = np.random.default_rng(2), np.arange(30.0)
    values = 5e-7 * np.exp(0.25 * times + 0.3 * rng.standard_normal(30))
    folder.mkdir()
    model = model_in(folder, GROWTH.format(size))
    rows = "\n".join(f"{t},{x}" for t, x in zip(times, values, strict=True))
    (folder / "d.csv").write_text(f"t,I\n{rows}\n", encoding="utf-8")
    return train(model, read(folder / "d.csv", model, Findings()), FAST, folder / "run")


def minus2(run: Run) -> float:
    likelihood = run.fit.members[0].likelihood
    assert likelihood is not None and likelihood.minus2ll is not None
    return likelihood.minus2ll


def test_disturbances_that_begin_too_large_end_near_none(tmp_path: Path) -> None:
    without, large = fitted(tmp_path / "without", "const s = 0"), fitted(tmp_path / "large", "learn s = 1e-4 > 0")
    assert minus2(large) < minus2(without) + 0.5
    assert large.fit.constants["r"].value == pytest.approx(without.fit.constants["r"].value, rel=0.03)


def test_networks_are_left_as_they_are(tmp_path: Path) -> None:
    assert near_none(*engine_of(tmp_path, WITH_NETWORK, table("X V y"))) is None
