"""Refits along a profile: the lowest ones, at a step that is short enough, compared with scipy's in closed form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

import gbspec
from gbspec.arrays import Array
from gbspec.training.profile.result import Profile

pytestmark = pytest.mark.usefixtures("quick_fits")

LEAF = """\
model leaf "Leaching and slow decay of litter"
time t : day from 0
state fast in [0, 5]
state slow in [0, 5]
learn M0 = 4.5 in [3, 6]
learn share = 0.3 in [0.01, 0.99]
learn kf = 0.3 in [0.01, 5]
learn ks = 0.003 in [1e-5, 0.2]
fast' = -kf*fast
slow' = -ks*slow
initial fast = share*M0
initial slow = (1 - share)*M0
observe mass = fast + slow
"""
ONE = LEAF.replace("learn ks = 0.003 in [1e-5, 0.2]\n", "").replace("-ks*slow", "-0.0003*slow")
NAMES = ("M0", "share", "kf", "ks")
LOW, HIGH = np.array([3, 0.01, 0.01, 1e-5]), np.array([6, 0.99, 5, 0.2])
STARTS = [
    *((4.5, 0.3, 0.45, ks) for ks in (1.1e-5, 3e-4, 1e-3, 5e-3)),
    *((4.5, share, 0.011, 0.1) for share in (0.3, 0.9)),
]


def litter(seed: int, sd: float = 0.58) -> tuple[Array, Array]:
    """Times and masses of five bags at each of some days."""
    t = np.repeat([0.0, 3, 7, 10, 15, 21, 28, 42, 57, 82, 105], 5)
    noise = sd * np.random.default_rng(seed).standard_normal(len(t))
    return t, 4.5 * (0.3 * np.exp(-0.45 * t) + 0.7 * np.exp(-3e-4 * t)) + noise


def deviances(t: Array, y: Array, name: str, values: list[float], fixed: dict[str, float]) -> list[float]:
    """The deviance of a constant at some values: least squares of all others from several starts."""

    def least(given: dict[str, float]) -> float:
        free = [i for i, one in enumerate(NAMES) if one not in given]

        def residuals(z: Array) -> Array:
            p = np.array([given.get(one, 0.0) for one in NAMES])
            p[free] = z
            return np.asarray(p[0] * (p[1] * np.exp(-p[2] * t) + (1 - p[1]) * np.exp(-p[3] * t)) - y)

        bounds, size = (LOW[free], HIGH[free]), np.array([1, 0.1, 0.1, 1e-3])[free]
        fits = [least_squares(residuals, np.array(s)[free], bounds=bounds, x_scale=size, xtol=1e-12) for s in STARTS]
        return 2 * min(float(one.cost) for one in fits)

    best = least(fixed)
    variance = best / (len(y) - len(NAMES) + len(fixed))
    return [(least(fixed | {name: value}) - best) / variance for value in values]


def run_of(folder: Path, text: str, t: Array, y: Array, **options: object) -> gbspec.FittedRun:
    (folder / "leaf.gb").write_text(text)
    rows = "".join(f"{a},mass,{b}\n" for a, b in zip(t, y, strict=True))
    (folder / "leaf.csv").write_text("t,name,value\n" + rows)
    gbspec.train(folder / "leaf.gb", folder / "leaf.csv", folder / "run", effort="low", **options)
    return gbspec.open_run(folder / "run")


def agrees(found: Profile, t: Array, y: Array, fixed: dict[str, float]) -> None:
    """All fits have converged, and deviances are right to 1 % (or 0.01)."""
    assert found.settled
    true = deviances(t, y, found.name, [point.value for point in found.points], fixed)
    assert [point.deviance for point in found.points] == pytest.approx(true, rel=0.01, abs=0.01)


@pytest.mark.parametrize("name", ["kf", "ks"])
def test_refits_do_not_rest_where_a_constant_has_no_effect(tmp_path: Path, name: str) -> None:
    t, y = litter(3)
    found = run_of(tmp_path, LEAF, t, y, max_step=0.1).profile(name)
    agrees(found, t, y, {})
    assert not any("step" in note for note in found.notes)
    if name == "kf":
        assert found.high is None and any("do not bound kf above" in note for note in found.notes)


@pytest.mark.parametrize(("text", "fixed"), [(LEAF, {}), (ONE, {"ks": 3e-4})])
def test_the_step_of_a_profile_is_short_enough_for_its_values(
    tmp_path: Path, text: str, fixed: dict[str, float]
) -> None:
    t, y = litter(3)
    run = run_of(tmp_path, text, t, y)
    found = run.profile("kf")
    agrees(found, t, y, fixed)
    assert (
        found.high is None
    )  # the true profile is flat from kf = 2 on, where the solution is unstable at the fit's step
    assert any(note.startswith("the largest step of 1 of the fit is too large for kf = ") for note in found.notes)
    again = run.profile("kf")
    assert (again.points, again.notes) == (found.points, found.notes), "from the stored fits"


def test_steps_that_are_only_compared_need_no_fit_of_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gbspec.training.profile.refits import Refits

    asked, offset = set(), Refits._offset

    def noted(self: Refits, fraction: float) -> float:
        asked.add(fraction)
        return offset(self, fraction)

    monkeypatch.setattr(Refits, "_offset", noted)
    found = run_of(tmp_path, LEAF, *litter(3), max_step=0.1).profile("ks")
    assert asked == {1.0} and not any("step" in note for note in found.notes)


def test_a_deviance_that_depends_on_the_step_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.profile.refits.FINEST", 1.0)
    found = run_of(tmp_path, ONE, *litter(3)).profile("kf")
    assert any("the deviance depends on the solver's step" in note for note in found.notes)


def test_a_value_that_cannot_be_fitted_is_left_out_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There are no solutions with a rate above 2.7."""
    from gbspec.training.optimise import Penalised

    value, gradient, equations = Penalised.value, Penalised.gradient, Penalised.equations

    def possible(target: Penalised, theta: Array) -> bool:
        return float(target.parameters.constants(torch.from_numpy(theta)).numpy()[0, -1]) < 2.7

    def none(target: Penalised, theta: Array) -> Any:
        if not possible(target, theta):
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        return equations(target, theta)

    run = run_of(tmp_path, ONE, *litter(3), max_step=0.1)
    monkeypatch.setattr(Penalised, "value", lambda s, p: value(s, p) if possible(s, p) else np.inf)
    monkeypatch.setattr(Penalised, "gradient", lambda s, p: gradient(s, p) if possible(s, p) else (np.inf, 0 * p))
    monkeypatch.setattr(Penalised, "equations", none)
    found = run.profile("kf")
    assert max(point.value for point in found.points) < 2.7 and found.high is None
    assert any(note.startswith("nothing could be fitted with kf = 3.") for note in found.notes)
    assert not any("do not bound kf above" in note for note in found.notes)
    assert found.low is not None


def test_a_start_that_cannot_be_linearised_is_no_defect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gbspec.training.optimise import Penalised

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("the matrix is not positive definite")

    run = run_of(tmp_path, ONE, *litter(3), max_step=0.1)
    monkeypatch.setattr(Penalised, "equations", fails)
    with pytest.raises(gbspec.ComputationError, match="cannot be started"):
        run.profile("kf")


def test_starts_that_the_fit_released_are_released_in_the_profile(tmp_path: Path) -> None:
    text = "model fall\nstate x in [0, 5]\nlearn k = 0.3 in [0.01, 3]\nx' = -k*x\nobserve x\n"
    t = np.linspace(0, 4, 25)
    y = 3 * np.exp(-0.5 * t) + 0.1 * np.random.default_rng(1).standard_normal(25)
    (tmp_path / "fall.gb").write_text(text)
    (tmp_path / "fall.csv").write_text("t,x\n" + "".join(f"{a},{b}\n" for a, b in zip(t, y, strict=True)))
    run = gbspec.train(tmp_path / "fall.gb", tmp_path / "fall.csv", tmp_path / "run", effort="low")
    found = gbspec.open_run(tmp_path / "run").profile("k", points=2)
    assert run.learned_starts()["x"][0] != y[0]
    assert not any("stay as measured" in note for note in found.notes)
