"""Replicates: their scatter is part of the noise, and shows whether the model lacks something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import f

import gbspec
from gbspec import frontend
from gbspec.data import Trajectories, from_arrays, to_arrays
from gbspec.diagnostics import Findings
from gbspec.operations.tables import read_data
from gbspec.report.text import run_summary
from gbspec.runs import FitRecord
from gbspec.training.runs.verdict import lacking

DECAY = """\
model decay
state y in [0, 20]
learn A = 8 in [1, 20]
learn k = 0.3 in [0.01, 5]
y' = -k*y
initial y = A
observe y
"""
TIMES = np.repeat([0.0, 1.0, 2.0, 3.0, 5.0, 8.0], 4)


def measured(path: Path, values: np.ndarray) -> Path:
    """A table of the long layout."""
    rows = [f"a,{t},y,{y}" for t, y in zip(TIMES, values, strict=True)]
    path.write_text("\n".join(["trajectory,t,name,value", *rows]) + "\n")
    return path


def fitted(folder: Path, values: np.ndarray, model: str = DECAY) -> FitRecord:
    (folder / "m.gb").write_text(model)
    gbspec.load(folder / "m.gb").train(measured(folder / "d.csv", values), folder / "run")
    return gbspec.open_run(folder / "run").run.fit


def noisy(curve: np.ndarray) -> np.ndarray:
    return curve + 0.3 * np.random.default_rng(1).standard_normal(len(TIMES))


def test_constants_are_as_uncertain_as_if_replicates_were_values_of_their_own(tmp_path: Path) -> None:
    values = noisy(10 * np.exp(-0.4 * TIMES))
    fit = fitted(tmp_path, values)
    each = least_squares(lambda p: p[0] * np.exp(-p[1] * TIMES) - values, [8, 0.3])
    variance = 2 * each.cost / (len(values) - 2)
    deviations = np.sqrt(variance * np.diag(np.linalg.inv(each.jac.T @ each.jac)))
    for name, value, sd in zip(("A", "k"), each.x, deviations, strict=True):
        assert fit.constants[name].value == pytest.approx(value, rel=1e-4)
        assert fit.constants[name].sd == pytest.approx(sd, rel=1e-3)
    assert fit.noise["y"] == pytest.approx(np.sqrt(variance), rel=1e-3)
    assert fit.members[0].freedom == pytest.approx(22, abs=1e-3)
    left = 2 * each.cost - sum(((one - one.mean()) ** 2).sum() for one in values.reshape(6, 4))
    pure = (2 * each.cost - left) / 18
    channels = fit.members[0].channels or {}
    assert channels["y"].lack_of_fit == pytest.approx(f.sf(left / 4 / pure, 4, 18), rel=1e-3)
    assert not [text for text in fit.warnings if "replicates" in text]
    assert (channels["y"].values, channels["y"].averages, channels["y"].censored) == (6, 6, None)
    said = run_summary(gbspec.open_run(tmp_path / "run").run)
    assert "rmse and R² of `y` (6 of 6 values): of averages of replicates" in said


def test_a_model_that_lacks_something_is_told_by_replicates(tmp_path: Path) -> None:
    fit = fitted(tmp_path, noisy(3 + 7 * np.exp(-0.4 * TIMES)))
    (said,) = [text for text in fit.warnings if "replicates" in text]
    assert "averages of `y` are further from the solutions" in said
    channels = fit.members[0].channels or {}
    assert lacking({"y": replace(channels["y"], lack_of_fit=0.2)}) == []


def test_logarithms_have_relative_scatter(tmp_path: Path) -> None:
    values = 10 * np.exp(-0.4 * TIMES + 0.05 * np.random.default_rng(2).standard_normal(len(TIMES)))
    fit = fitted(tmp_path, values, DECAY.replace("observe y", "learn s = 0.1 > 0\nobserve y noise lognormal(0.05)"))
    channels = fit.members[0].channels or {}
    assert channels["y"].lack_of_fit is not None
    assert 0.01 < channels["y"].lack_of_fit < 0.99


def test_scatter_is_read_cut_and_kept(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(DECAY)
    values = noisy(10 * np.exp(-0.4 * TIMES))
    model = frontend.load_model(tmp_path / "m.gb", Findings())
    data = read_data(measured(tmp_path / "d.csv", values), model, Findings())
    (item,) = data.items
    assert item.scatter is not None
    expected = [((one - one.mean()) ** 2).sum() for one in values.reshape(6, 4)]
    assert item.scatter[:, 0] == pytest.approx(expected)
    part = item.at_rows(np.arange(6) % 2 == 0)
    assert part.scatter is not None
    assert part.scatter[:, 0] == pytest.approx(expected[::2])
    arrays, remarks = to_arrays(data)
    again = from_arrays(arrays, list(remarks["labels"]), list(remarks["channels"]), 0, 0)
    assert isinstance(again, Trajectories)
    assert again.items[0].scatter is not None
    assert np.array_equal(again.items[0].scatter, item.scatter)


LEARNED = DECAY.replace("learn k", "learn s = 0.2 in [0.01, 2]\nlearn k").replace(
    "observe y", "observe y noise normal(s)"
)
PROPORTIONAL = LEARNED.replace("[1, 20]\n", "[1, 20] per trajectory ~ lognormal\n").replace("normal(s)", "normal(s*y)")

LOGARITHMS = LEARNED.replace("normal(s)", "lognormal(s)")


def test_replicates_of_logarithms_have_the_geometric_average(tmp_path: Path) -> None:
    """With the standard deviation and the scatter of logarithms, in the unit of the values."""
    (tmp_path / "m.gb").write_text(LOGARITHMS)
    (tmp_path / "d.csv").write_text("trajectory,t,name,value,sd\na,0,y,2,0.2\na,0,y,8,0.4\na,1,y,3,0.3\n")
    data = read_data(tmp_path / "d.csv", frontend.load_model(tmp_path / "m.gb", Findings()), Findings())
    (item,) = data.items
    assert item.values[:, 0] == pytest.approx([4.0, 3.0])
    assert item.sd[:, 0] == pytest.approx([4 * np.hypot(0.1, 0.05) / 2, 0.3])
    assert item.scatter is not None
    assert item.scatter[:, 0] == pytest.approx([4**2 * 2 * np.log(2) ** 2, 0.0])


def table(path: Path, apart: float) -> Path:
    """Six decays from starts of their own, of which each value is measured three times, `apart` in time."""
    rng, rows = np.random.default_rng(8), []
    for i in range(6):
        start = 8 * np.exp(0.2 * rng.standard_normal())
        for t in (0.0, 0.7, 1.5, 3.0, 5.0):
            for k in range(3):
                value = start * np.exp(-0.4 * t) * (1 + 0.1 * rng.standard_normal())
                rows.append(f"{i},{t + apart * k},y,{float(value)!r}")
    path.write_text("\n".join(["trajectory,t,name,value", *rows]) + "\n")
    return path


@pytest.mark.parametrize("model", [LEARNED, PROPORTIONAL, LOGARITHMS])
def test_the_likelihood_of_replicates_is_that_of_rows_of_their_own(tmp_path: Path, model: str) -> None:
    """Rows so close to each other that the solution does not change between them."""
    (tmp_path / "m.gb").write_text(model.replace("state y", "time t from 0\nstate y"))
    fits = []
    for name, apart in (("replicates", 0.0), ("rows", 1e-7)):
        data = table(tmp_path / f"{name}.csv", apart)
        gbspec.load(tmp_path / "m.gb").train(data, tmp_path / name)
        fits.append(gbspec.open_run(tmp_path / name).run.fit)
    replicates, rows = fits
    for name, one in replicates.constants.items():
        assert one.value == pytest.approx(rows.constants[name].value, rel=1e-3), name
        assert one.sd == pytest.approx(rows.constants[name].sd, rel=1e-2), name
    assert not [text for text in replicates.warnings if "replicates" in text], "subjects differ, the model is right"
    found = [one.population for one in fits if one.population is not None]
    assert found[0].minus2ll == pytest.approx(found[1].minus2ll, abs=1e-3)
    assert found[0].bic == pytest.approx(found[1].bic, abs=1e-3)
    at = [gbspec.open_run(tmp_path / name).evaluate(tmp_path / f"{name}.csv") for name in ("replicates", "rows")]
    assert at[0].nllh == pytest.approx(at[1].nllh, abs=1e-3)
    assert replicates.noise["y"] == pytest.approx(rows.noise["y"], rel=1e-3), "that of a single measurement"
