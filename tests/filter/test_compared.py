"""Models with disturbances are compared by the maxima of their likelihoods, where these are of the same values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from gbspec.diagnostics import UserError
from gbspec.operations import comparing
from gbspec.report import run_summary
from gbspec.runs import LikelihoodRecord, Run
from gbspec.training import filter_run, train
from tests.filter.test_fits import DRIFT, FAST, data_in, model_in

Fit = Callable[..., Run]


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    """Fits a text to the same 40 rows, once."""
    made: dict[str, Run] = {}

    def of(text: str, rows: int = 40) -> Run:
        key = f"{text}{rows}"
        if key not in made:
            folder = tmp_path_factory.mktemp("compared")
            model = model_in(folder, text)
            made[key] = train(model, data_in(folder, model, rows), FAST, folder / "run")
        return made[key]

    return of


FIXED = DRIFT.replace("learn theta = 0.5 in [0.01, 10]", "const theta = 0.3")
STATED = DRIFT.replace("observe X", "observe X noise normal(0.2)")


def likelihood(run: Run) -> LikelihoodRecord:
    found = run.fit.members[0].likelihood
    assert found is not None
    return found


def test_the_maximum_is_that_of_the_likelihood_itself(fit: Fit, tmp_path: Path) -> None:
    run = fit(DRIFT)
    found = likelihood(run)
    data = data_in(tmp_path, run.model, 40)
    filtered = filter_run(run, data, 0)
    engine = filtered.engine
    best = minimize(engine.value, filtered.vector, method="Nelder-Mead", options={"maxiter": 2000, "fatol": 1e-7})
    assert found.least is not None and found.minus2ll is not None
    assert found.least == pytest.approx(2 * best.fun, abs=0.01)
    assert 0.02 < found.minus2ll - found.least < 0.5  # the sizes of the fit are those of the restricted likelihood
    assert f"-2 log likelihood {found.least:.4f} (innovations; at its maximum), 4 parameters" in run_summary(run)


PRIOR = DRIFT.replace("in [0.01, 10]", "in [0.01, 10] prior lognormal(0.3, 0.1)")
FUNCTION = DRIFT.replace("theta*(mu - X)", "f(X)").replace(
    "learn theta = 0.5 in [0.01, 10]\n", "unknown f(X in [-2, 4]) by mlp(2)\n"
)


@pytest.mark.parametrize(("text", "said"), [(PRIOR, "constants with a prior"), (FUNCTION, "unknown functions")])
def test_fits_with_priors_are_at_no_maximum(fit: Fit, text: str, said: str) -> None:
    run = fit(text)
    found = likelihood(run)
    assert found.minus2ll is not None and found.least is None and found.aic is None and found.bic is None
    line = next(one for one in run_summary(run).splitlines() if one.startswith("-2 log likelihood"))
    assert (
        line == f"-2 log likelihood {found.minus2ll:.4f} (innovations; at the estimates), {found.parameters} parameters"
    )
    with pytest.raises(UserError) as refused:
        comparing.compare([fit(DRIFT), run])
    assert said in refused.value.diagnostics[0].message and "maximum" in refused.value.diagnostics[0].message


def test_a_spline_has_as_many_parameters_as_coefficients(fit: Fit) -> None:
    run = fit(FUNCTION.replace("mlp(2)", "spline(5)"))
    assert likelihood(run).parameters == 5 + len(run.model.learnables) + 1  # and the noise
    assert run.model.networks[0].parameters == 5


def test_nested_models_are_tested(fit: Fit) -> None:
    small, large, stated = fit(FIXED), fit(DRIFT), fit(STATED)
    found = comparing.compare([small, large, stated])
    assert [one.parameters for one in found.runs] == [3, 4, 3]
    tests = {(Path(one.smaller), Path(one.larger)): one for one in found.tests}
    assert set(tests) == {(small.path, large.path), (stated.path, large.path)}
    test = tests[small.path, large.path]
    assert test.fall == pytest.approx(found.runs[0].minus2ll - found.runs[1].minus2ll)
    assert test.freedom == 1 and 0 < test.p < 1 and not test.boundary and test.fall > 0


def test_a_disturbance_less_is_at_the_edge(fit: Fit) -> None:
    hidden = DRIFT.replace("state X", "state d = 0\nstate X").replace("theta*(mu - X)", "theta*(mu - X) + d")
    hidden = hidden.replace("diffusion X", "d' = -d\ndiffusion X")
    more = hidden.replace("diffusion X", "diffusion d = q\ndiffusion X").replace(
        "learn s", "learn q = 0.1 in [0, 5]\nlearn s"
    )
    (test,) = comparing.compare([fit(hidden), fit(more)]).tests
    assert test.boundary and test.freedom == 1 and test.fall > -0.01


@pytest.mark.parametrize(
    ("text", "rows", "said"),
    [
        (STATED + "initial X learn\n", 40, "different starts of the state that `X` measures"),
        (DRIFT.replace("= 0\n", "= 1\n", 1) + "initial X = 1\n", 40, "different starts of the state that `X` measures"),
        (DRIFT, 39, "fitted to different data"),
        (DRIFT.replace("diffusion X = s\n", "").replace("X\n", "X noise normal(s)\n"), 40, "different kinds"),
    ],
)
def test_likelihoods_of_other_values_are_refused(fit: Fit, text: str, rows: int, said: str) -> None:
    with pytest.raises(UserError) as refused:
        comparing.compare([fit(DRIFT), fit(text, rows)])
    assert said in refused.value.diagnostics[0].message


def test_a_fit_of_squares_is_refused_by_its_reason(fit: Fit) -> None:
    squares = DRIFT.replace("diffusion X = s\n", "").replace("learn s = 0.3 in [0, 5]\n", "")
    with pytest.raises(UserError) as refused:
        comparing.compare([fit(DRIFT), fit(squares)])
    assert "was not fitted by a likelihood" in refused.value.diagnostics[0].message
    assert "`diffusion`" in str(refused.value.diagnostics[0].help)
    assert np.isfinite(likelihood(fit(DRIFT)).aic or np.nan)
