"""compare: likelihood ratio, AIC and BIC of runs of the same data, against closed forms, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.training import TrainOptions, train
from tests.training.test_populations import LEVEL, exact, model_of, table

Run = Callable[..., Any]
OPTIONS = TrainOptions(backend="torch", max_step=1.0, effort="low")
SHARED = LEVEL.replace(" per trajectory ~ normal(s)\nlearn s = 1 > 0", "")
SQUARES = SHARED.replace("learn e = 0.5 > 0\n", "").replace(" noise normal(e)", "")


def values() -> np.ndarray:
    random = np.random.default_rng(1)
    return 5 + 1.5 * random.standard_normal((8, 1)) + 0.4 * random.standard_normal((8, 4))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of a random level, of one for all, of that by least squares, by quadrature, of other data, with a prior."""
    folder = tmp_path_factory.mktemp("compare")

    def fit(name: str, text: str, data: np.ndarray, options: TrainOptions = OPTIONS) -> None:
        model = model_of(text, folder)
        path = table(folder, data, np.arange(4.0))
        train(model, tables.read_data(path, model, Findings()), options, folder / name)

    fit("each", LEVEL, values())
    fit("shared", SHARED, values())
    fit("squares", SQUARES, values())
    fit("nodes", LEVEL, values(), TrainOptions(backend="torch", max_step=1.0, effort="low", quadrature=3))
    fit("other", LEVEL, values() + 1)
    fit("prior", LEVEL.replace("~ normal(s)", "~ normal(s) prior normal(2, 0.5)"), values())
    return folder


@pytest.fixture
def place(runs: Path, here: Path) -> Path:
    for name in ("each", "shared", "squares", "nodes", "other", "prior"):
        shutil.copytree(runs / name, here / name)
    return here


def maxima() -> tuple[float, float]:
    """The least -2 log likelihood with one level for all, and with levels of their own."""
    found = values()
    n, center = found.shape[1], found.mean(axis=1)
    within = ((found - center[:, None]) ** 2).sum() / (found.size - len(found))
    between = center.var() - within / n
    return exact(found, found.mean(), 0.0, found.std()), exact(found, center.mean(), between**0.5, within**0.5)


def test_nested_runs_are_tested_by_their_likelihoods(place: Path, document: Run, gbspec: Run) -> None:
    made = document("compare", "shared", "each")
    smaller, larger = maxima()
    first, second = made["runs"]
    assert (first["run"], first["parameters"], second["parameters"]) == ("shared", 2, 3)
    assert first["minus2ll"] == pytest.approx(smaller, abs=1e-4)
    assert second["minus2ll"] == pytest.approx(larger, abs=1e-4)
    assert first["aic"] == pytest.approx(first["minus2ll"] + 4)
    assert second["bic"] == pytest.approx(second["minus2ll"] + 3 * np.log(32))
    (test,) = made["tests"]
    assert (test["smaller"], test["larger"], test["freedom"], test["boundary"]) == ("shared", "each", 1, True)
    assert test["p"] == pytest.approx(chi2.sf(smaller - larger, 1), rel=1e-3)
    assert made["differences"]["each"] == ["learn m = 5 in [-50, 50] per trajectory ~ normal(s)", "learn s = 1 > 0"]
    text = gbspec("compare", "shared", "each").stdout
    assert "AIC above the least" in text
    assert "1 further parameter, p =" in text
    assert "too large" in text


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("each", "other"), "were fitted to different data"),
        (("squares", "each"), "was not fitted by a likelihood"),
        (("each", "nodes"), "computed in different ways"),
        (("each", "columns"), "do not observe the same columns"),
        (("each", "nowhere"), "nowhere"),
        (("each", "absent"), "different numbers of values of the same table"),
        (("each", "prior"), "`prior` has constants with a prior: it is not at a maximum of likelihood"),
    ],
)
def test_what_cannot_be_compared_is_refused(place: Path, gbspec: Run, names: tuple[str, str], said: str) -> None:
    if "columns" in names:
        model = model_of(LEVEL + "observe z = 2*x\n", place)
        path = place / "more.csv"
        path.write_text("trajectory,t,x,z\n1,0,1,2\n1,1,1.2,2.1\n2,0,3,6.1\n2,1,3.1,6.2\n")
        for name, text in (("each", LEVEL), ("columns", LEVEL + "observe z = 2*x\n")):
            shutil.rmtree(place / name, ignore_errors=True)
            model = model_of(text, place)
            train(model, tables.read_data(path, model, Findings()), OPTIONS, place / name)
    if "absent" in names:  # 0 in one trajectory, which one of the models keeps there
        path = place / "zero.csv"
        path.write_text("trajectory,t,x\n1,0,0\n1,1,0\n2,0,3\n2,1,3.1\n2,2,3.2\n")
        for name, balance in (("each", "x' = r*x"), ("absent", "x' = r*x + r")):
            shutil.rmtree(place / name, ignore_errors=True)
            learned = "learn r = 0.1 in [-1, 1]\nlearn e = 0.5 > 0"
            model = model_of(f"model zero\nstate x\n{learned}\n{balance}\nobserve x noise normal(e)\n", place)
            train(model, tables.read_data(path, model, Findings()), OPTIONS, place / name)
    done = gbspec("compare", *names)
    assert done.exit_code == 1
    assert said in done.stderr


def test_one_run_is_shown(place: Path, document: Run) -> None:
    made = document("compare", "each")
    assert len(made["runs"]) == 1
    assert made["tests"] == []
