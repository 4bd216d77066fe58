"""Learned starts that lie far from measured first values are told, with what can be written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

GROWTH = """\
model product
state P in [0, 20]
learn k = 0.3 in [0.01, 2]
P' = k*(10 - P)
observe P
"""
TIMES = np.arange(0.0, 15.1, 0.5)


def warnings_of(folder: Path, curves: list[np.ndarray], model: str = GROWTH) -> list[str]:
    """The warnings of a fit of these curves, with noise of 0.05 except in the first row, that name a start."""
    rng, rows = np.random.default_rng(4), ["trajectory,t,P"]
    for i, curve in enumerate(curves):
        noise = 0.05 * rng.standard_normal(len(TIMES)) * (TIMES > 0)
        rows += [f"e{i},{t},{y}" for t, y in zip(TIMES, curve + noise, strict=True)]
    (folder / "m.gb").write_text(model)
    (folder / "d.csv").write_text("\n".join(rows) + "\n")
    gbspec.load(folder / "m.gb").train(folder / "d.csv", folder / "run")
    found = gbspec.open_run(folder / "run").run.fit.warnings
    return [text for text in found if "first values count" in text]


def test_zeros_that_the_fit_leaves_are_told(tmp_path: Path) -> None:
    late = np.where(TIMES > 0, 10 - 7 * np.exp(-0.3 * TIMES), 0.0)
    (said,) = warnings_of(tmp_path, [late, late])
    assert "the first value of `P` is 0 in all 2 trajectories, and the fit starts at up to 1." in said
    assert "write `initial P = 0`" in said


def test_what_is_offered_names_the_state(tmp_path: Path) -> None:
    late = np.where(TIMES > 0, 10 - 7 * np.exp(-0.3 * TIMES), 0.0)
    model = GROWTH.replace("observe P", 'observe C = P as "P"')
    (said,) = warnings_of(tmp_path, [late, late], model)
    assert "the first value of `C` is 0" in said and "write `initial P = 0`" in said


def test_first_values_beyond_the_noise_are_told(tmp_path: Path) -> None:
    late = np.where(TIMES > 0, 10 - 7 * np.exp(-0.3 * TIMES), 0.5)
    (said,) = warnings_of(tmp_path, [late])
    assert "the fit starts `P` at 1." in said and "where 0.5 was measured" in said
    assert "standard deviations of the noise" in said and "`initial P = P_0`" in said


def test_starts_of_another_size_are_told(tmp_path: Path) -> None:
    """Beside the last values 0.9 is small."""
    model = GROWTH.replace("k*(10 - P)", "k*P").replace("learn k = 0.3", "learn k = 0.8")
    curve = np.where(TIMES > 0, 1e-3 * np.exp(0.65 * TIMES), 0.9)
    (said,) = warnings_of(tmp_path, [curve], model)
    assert "where 0.9 was measured" in said


@pytest.mark.parametrize("first", [0.0, 2.0])
def test_nothing_is_said_of_starts_within_the_noise(tmp_path: Path, first: float) -> None:
    curve = 10 - (10 - first) * np.exp(-0.3 * TIMES)
    assert warnings_of(tmp_path, [curve, curve]) == []
