"""evaluate: likelihoods that are integrals, over populations and disturbances, and censored values; closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import gbspec as package
from gbspec.diagnostics import UserError
from gbspec.operations import evaluating

Run = Callable[..., Any]

POPULATION = """\
model shift
time t from 0
learn b = 1 in [-10, 10] per trajectory ~ normal
learn a = 0.5 in [0.1, 3]
learn s = 0.3 in [0.01, 10]
state X = 1
X' = -a*X
initial X = 1
observe y = b + X noise normal(s)
"""
ROWS = {"one": ([0.5, 1.0, 2.0], [1.9, 1.4, 1.6]), "two": ([0.2, 3.0], [2.4, 1.9])}
DISTURBED = """\
model walk
learn a = 0.5 in [0.1, 3]
learn q = 0.4 in [0.01, 3]
state X = 1
X' = -a*X
diffusion X = q
initial X = 1
observe y = X noise normal(0.2)
"""
LIMITS = """\
model limits
learn k = 0.7 in [0.1, 3]
learn s = 0.2 in [0.01, 3]
state X = 1
X' = -k*X
initial X = 1
observe y = X noise normal(s)
observe z = 2*X noise lognormal(0.4)
"""


def shifted(b: float, a: float, s: float, sd: float) -> float:
    """The marginal likelihood, which is normal: the values of a trajectory share one deviation."""
    total = 0.0
    for times, values in ROWS.values():
        mean = b + np.exp(-a * np.array(times))
        covariance = s**2 * np.eye(len(times)) + sd**2
        total -= multivariate_normal(mean, covariance).logpdf(values)
    return total


def walked(a: float, q: float) -> float:
    """The likelihood of an Ornstein-Uhlenbeck process: one normal density of all values."""
    times, values = np.array([0.5, 1.0, 2.5]), [0.9, 0.3, 0.4]
    early, late = np.minimum.outer(times, times), np.maximum.outer(times, times)
    covariance = q**2 / (2 * a) * (np.exp(-a * (late - early)) - np.exp(-a * (late + early))) + 0.04 * np.eye(3)
    return -float(multivariate_normal(np.exp(-a * times), covariance).logpdf(values))


def limited(k: float, s: float) -> float:
    """One value, one limit below and one above, one of a logarithm."""
    sd = np.sqrt(np.log1p(0.16))
    logs = (np.log(0.9) - np.log(2 * np.exp(-k))) / sd
    x = np.exp(-k * np.array([0.5, 2.0, 1.5]))
    terms = [norm(x[0], s).logpdf(0.8), norm(x[1], s).logcdf(0.15), norm(x[2], s).logsf(0.3)]
    return float(
        -sum(terms) - norm.logpdf(logs) + np.log(sd) + np.log(0.9) - norm.logcdf((np.log(0.2) + k * 3 - np.log(2)) / sd)
    )


def slopes(function: Callable[..., float], point: list[float]) -> list[float]:
    h, found = 1e-5, []
    for i in range(len(point)):
        up, down = ([v + (j == i) * d for j, v in enumerate(point)] for d in (h, -h))
        found.append((function(*up) - function(*down)) / (2 * h))
    return found


def test_a_population_has_its_marginal_likelihood(here: Path, document: Run) -> None:
    (here / "m.gb").write_text(POPULATION)
    rows = [f"{name},{t},{y}" for name, part in ROWS.items() for t, y in zip(*part, strict=True)]
    (here / "d.csv").write_text("\n".join(["trajectory,t,y", *rows]) + "\n")
    made = document("evaluate", "m.gb", "d.csv", "--set", "b=1.2", "--set", "sd_b=0.6")
    point = [1.2, 0.5, 0.3, 0.6]
    assert made["nllh"] == pytest.approx(shifted(*point), rel=1e-7)
    expected = slopes(shifted, point)
    for name, slope in zip(("b", "a", "s", "sd_b"), expected, strict=True):
        assert made["gradient"][name] == pytest.approx(slope, rel=1e-5)
    residuals = [one["residual"] for one in made["simulation"]]
    assert made["chi2"] == pytest.approx(sum(r**2 for r in residuals))
    assert len(residuals) == 5
    assert made["accuracy"] < 1e-6


def test_a_population_needs_its_noise(here: Path, gbspec: Run) -> None:
    (here / "m.gb").write_text(POPULATION.replace(" noise normal(s)", "").replace("learn s = 0.3 in [0.01, 10]\n", ""))
    (here / "d.csv").write_text("trajectory,t,y\none,1,1.4\ntwo,1,1.9\n")
    result = gbspec("evaluate", "m.gb", "d.csv")
    assert "GB886" in result.stderr
    assert "--set noise_y=" in result.stderr
    assert gbspec("evaluate", "m.gb", "d.csv", "--set", "noise_y=0.3").exit_code == 0


def test_disturbances_have_the_likelihood_of_innovations(here: Path) -> None:
    (here / "m.gb").write_text(DISTURBED)
    (here / "d.csv").write_text("t,y\n0,\n0.5,0.9\n1,0.3\n2.5,0.4\n")
    made = package.evaluate("m.gb", "d.csv", values={"q": 0.45})
    assert made.nllh == pytest.approx(walked(0.5, 0.45), rel=1e-9)
    for name, slope in zip(("a", "q"), slopes(walked, [0.5, 0.45]), strict=True):
        assert made.gradient[name] == pytest.approx(slope, rel=1e-6)
    assert made.found.simulation[0].value == pytest.approx(np.exp(-0.25))
    assert made.chi2 == pytest.approx(sum(one.residual**2 for one in made.found.simulation))


def test_disturbances_that_are_not_linear(here: Path) -> None:
    """The gradient is that of the likelihood itself, by differences."""
    (here / "m.gb").write_text(DISTURBED.replace("X' = -a*X", "X' = -a*X^2"))
    (here / "d.csv").write_text("t,y\n0,\n0.5,0.9\n1,0.3\n2.5,0.4\n")
    made = package.evaluate("m.gb", "d.csv")
    up, down = (package.evaluate("m.gb", "d.csv", values={"a": 0.5 + h}).nllh for h in (1e-4, -1e-4))
    assert made.gradient["a"] == pytest.approx((up - down) / 2e-4, rel=1e-5)


def test_limits_contribute_their_probability(here: Path) -> None:
    (here / "m.gb").write_text(LIMITS)
    (here / "d.csv").write_text("t,y,z\n0,,\n0.5,0.8,\n1,,0.9\n1.5,>0.3,\n2,<0.15,\n3,,<0.2\n")
    made = package.evaluate("m.gb", "d.csv")
    assert made.nllh == pytest.approx(limited(0.7, 0.2), rel=1e-8)
    for name, slope in zip(("k", "s"), slopes(limited, [0.7, 0.2]), strict=True):
        assert made.gradient[name] == pytest.approx(slope, rel=1e-6)
    assert [one.limit for one in made.found.simulation] == ["", "", ">", "<", "<"]
    places = (np.exp(-1.05) - 0.3) / 0.2
    assert made.found.simulation[2].residual ** 2 == pytest.approx(-2 * norm.logcdf(places))


def test_a_run_of_a_population_has_the_likelihood_of_its_fit(here: Path, quick_fits: None) -> None:
    (here / "m.gb").write_text(POPULATION.replace("learn a = 0.5 in [0.1, 3]", "const a = 0.5"))
    shifts = {"one": 0.2, "two": -0.5, "three": 0.9, "four": -0.4}
    rows = [
        f"{name},{t},{1 + shift + np.exp(-0.5 * t) + 0.1 * (-1) ** i}"
        for name, shift in shifts.items()
        for i, t in enumerate((0.5, 1.0, 2.0))
    ]
    (here / "d.csv").write_text("\n".join(["trajectory,t,y", *rows]) + "\n")
    run = package.train("m.gb", "d.csv", "run", effort="low", workers=1)
    record = run.run.fit.population
    assert record is not None
    found = run.evaluate()
    assert found.nllh == pytest.approx(record.minus2ll / 2, abs=1e-4)  # the fit has longer steps
    assert max(map(abs, found.gradient.values())) < 0.05
    assert run.evaluate(values={"sd_b": record.effects["b"].sd + 0.1}).nllh > found.nllh


def test_what_cannot_be_evaluated_is_said() -> None:
    distributed = SimpleNamespace(distributed=(1,), correlated=(("a", "b", "c"),))
    run = SimpleNamespace(model=distributed, fit=SimpleNamespace(population=1), best=0)
    with pytest.raises(UserError, match="three or more constants") as raised:
        evaluating._population_of_run(run, 0)  # type: ignore[arg-type]  # as much of a run as is looked at
    assert raised.value.diagnostics[0].code == "GB888"
