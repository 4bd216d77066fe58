"""Constants and functions in models with algebraic variables are found by fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

import gbspec
from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.passes.truth import with_truth
from tests.algebraic.models import BUFFER, built
from tests.training.conftest import problem_of, trajectory
from tests.training.reference import linearise, solve, whole_jacobian

TANK = BUFFER + "initial a = 0.01\ninitial b = 0.003\n"
WITH_UNKNOWN = TANK.replace("learn k = 0.2 in [0, 1]\n", "unknown r(pH) by mlp(4)\n").replace("k*a*pH/7", "r*a")
WITH_UNKNOWN = WITH_UNKNOWN.replace("truth k = 0.3", "truth r(pH) = 0.3*pH/7")


def solutions(text: str) -> Trajectories:
    """Rows of a solution by the truth, taken in the same steps as in a fit, without noise."""
    member = load_module(with_truth(built(text)))()
    times = np.arange(1.0, 7.0)
    states = member.simulate([0.01, 0.003], [0.0, *times], max_step=0.5)[1:]
    channels = member.observe(0.0, states).numpy()
    return Trajectories((trajectory("1", 0.0, times, channels, []),), ("pH", "a"))


@pytest.mark.parametrize("text", [TANK, WITH_UNKNOWN])
def test_constants_are_found_without_noise(text: str) -> None:
    model = built(text)
    problem, parameters, theta = problem_of(model, solutions(text), 0.5, blend=0.0)

    def jacobian(at: Array) -> Array:
        return np.asarray(whole_jacobian(linearise(problem, parameters, at), parameters).numpy())

    found = least_squares(
        lambda at: solve(problem, parameters, at), theta, jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=60
    )
    assert np.abs(found.fun).max() < (1e-9 if model.complete else 0.02)  # in standard deviations of the channels

    constants = dict(
        zip(model.constant_names, parameters.constants(torch.from_numpy(found.x))[0].tolist(), strict=True)
    )
    if model.complete:
        assert constants == pytest.approx({"pKa": 4.75, "k": 0.3, "c": 0.03}, rel=1e-8)


DIODE = """model diode
time t from 0
input u in [0, 3] held
state q in [0, 3]
algebraic v in [0, 3] = 0.5
learn R = 1 in [0.2, 5]
unknown i(v in [0, 3]) zero at v = 0, increasing in v by mlp(3)
q' = (v - q)/2
equation node: (u - v)/R = i(v) + (v - q)
initial q = 0
observe v
observe q
"""


@pytest.mark.usefixtures("quick_fits")
def test_an_unknown_function_inside_an_equation_is_trained(tmp_path: Path) -> None:
    """The warm start cannot replace its values by free numbers while the equation is solved, and leaves them alone."""
    (tmp_path / "m.gb").write_text(DIODE)
    (tmp_path / "d.csv").write_text("t,u,v,q\n0,2,,\n0.5,,0.9,0.2\n1,,1.0,0.4\n1.5,,1.1,0.5\n")
    model = gbspec.load(tmp_path / "m.gb")
    options = {"method": "lm", "epochs": 1, "max_step": 0.5, "threads": 1, "workers": 1}
    run = model.train(tmp_path / "d.csv", tmp_path / "run", **options).run
    assert np.isfinite(run.fit.members[0].loss)
    low, high = (float(run.member().weights[f"network.i.input_{end}"][0]) for end in ("low", "high"))
    assert 0 <= low < high <= 3
