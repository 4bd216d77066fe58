"""What fits of disturbed models begin with, and covariances within explicit steps."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.data import read
from gbspec.diagnostics import ComputationError, Findings
from gbspec.frontend import load_model
from gbspec.ir import METHODS, Explicit
from gbspec.training import TrainOptions, train
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.engines.filter.explicit import explicit_step
from gbspec.training.engines.filter.result import Information
from gbspec.training.engines.filter.sigma import Rates, Varied
from gbspec.training.optimise import InnovationsFit
from tests.filter.conftest import BENT, engine_of, table


@pytest.mark.parametrize("method", [one for one in METHODS.values() if isinstance(one, Explicit)])
def test_covariances_within_an_explicit_step_are_positive(method: Explicit) -> None:
    """Modes that decay by e^-2.5 within a step, of states that are correlated, and one disturbance."""
    f, square = np.array([[-2.5, 0.4], [0.1, -2.0]]), np.array([[1.0], [0.0]])
    cov, seen = np.array([[1.0, 0.9], [0.9, 0.82]]), []

    def stage(at: Fraction, m: Varied, p: Varied) -> Rates:
        seen.append(p.value[0])
        return Rates(Varied(f @ m.value), Varied(f[None]), Varied(square[None]))

    m, a, q = explicit_step(method, stage, Varied(np.ones((1, 2, 1))), Varied(cov[None]), np.ones(1))
    assert len(seen) >= method.advancing
    for each in (*seen, q.value[0], a.value[0] @ cov @ a.value[0].T + q.value[0]):
        assert np.linalg.eigvalsh(each).min() > -1e-12
    assert np.isfinite(m.value).all()


@pytest.mark.parametrize(("finite", "waiting"), [((1,), 0), ((0, 2), 1), ((0, 1, 2, 3), 2), ((), 0)])
def test_vectors_without_a_solution_are_no_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finite: tuple[int, ...], waiting: int
) -> None:
    engine, vector = engine_of(tmp_path, BENT, table("X V y", rows=4))
    theta, tried = engine.layout.split(vector)[0], []

    def value(_: FilterEngine, of: Array) -> float:
        tried.append(of)
        return float(len(tried)) if len(tried) - 1 in finite else np.inf

    monkeypatch.setattr(FilterEngine, "value", value)
    state = InnovationsFit("innovations", 10, lambda: engine, [theta + 0.1], None).begin(theta)
    assert len(state["waiting"]) == waiting
    first = np.concatenate([state["theta"], state["log_sd"]])
    assert np.array_equal(first, tried[min(finite, default=0)])


def test_a_start_is_tried_once(tmp_path: Path) -> None:
    """A warm start that moves nothing leaves the declared constants: eight iterations were those of another start."""
    engine, vector = engine_of(tmp_path, BENT, table("X V y", rows=4))
    theta = engine.layout.split(vector)[0]
    alone, again = (
        InnovationsFit("innovations", 10, lambda: engine, each, None).begin(theta) for each in ([], [theta])
    )
    assert np.array_equal(alone["waiting"], again["waiting"])
    assert len(alone["waiting"]) == 1


def test_a_start_whose_spread_diverges_is_told_with_its_remedy(tmp_path: Path) -> None:
    """The share p stays in [0, 1], but its start's distribution does not, and the balance grows without bound there."""
    text = (
        "model m\ntime t\nstate x in [0, 5] = 1\nstate p in [0, 1] = 0.7\nlearn k = 4 in [3, 5]\n"
        "learn s = 0.2 in [0, 2]\nx' = p - x\np' = k*p*(p - 1)*(0.5 - p)\ndiffusion x = s\nobserve x\n"
    )
    (tmp_path / "m.gb").write_text(text, encoding="utf-8")
    rows = "\n".join(f"{t},{0.6 + 0.1 * (-1) ** t}" for t in range(30, 40))
    (tmp_path / "d.csv").write_text(f"t,x\n0,\n{rows}\n", encoding="utf-8")
    model = load_model(tmp_path / "m.gb", Findings())
    with pytest.raises(ComputationError) as caught:
        train(model, read(tmp_path / "d.csv", model, Findings()), TrainOptions(effort="low"), tmp_path / "run")
    assert "`initial p learn`" in caught.value.remedy


def test_a_first_value_without_a_logarithm_is_told_where_no_step_is_short_enough(tmp_path: Path) -> None:
    text = "model z\ntime t\nstate x in [0, 10]\nlearn a = 0.5 in [0.01, 10]\nlearn k = 0.3 in [0.01, 10]\n"
    text += "learn s = 0.2 in [0.001, 5]\nx' = a - k*x\ndiffusion x = s*x\nobserve x noise normal(0.02)\n"
    times = np.arange(0.5, 20, 0.5)
    values = 1.6 * (1 - np.exp(-0.6 * times)) * (1 + 0.05 * np.sin(17 * times))
    model = tmp_path / "m.gb"
    model.write_text(text, encoding="utf-8")
    rest = [f"{t},{x:.5f}" for t, x in zip(times, values, strict=True)]

    def trained(first: str) -> None:
        (tmp_path / "d.csv").write_text("\n".join(["t,x", first, *rest]) + "\n", encoding="utf-8")
        known = load_model(model, Findings())
        data = read(tmp_path / "d.csv", known, Findings())
        train(known, data, TrainOptions(effort="low", backend="torch", device="cpu"), tmp_path / f"run{first[-1]}")

    with pytest.raises(ComputationError) as caught:
        trained("0,0")
    assert "the first value of `x`, 0, has no logarithm" in caught.value.remedy
    trained("0,")


def test_a_start_whose_iterations_fail_gives_way_to_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of several vectors one whose information is not finite does not end the fit; alone it does."""
    engine, vector = engine_of(tmp_path, BENT, table("X V y", rows=4))
    theta = engine.layout.split(vector)[0]
    fit = InnovationsFit("innovations", 30, lambda: engine, [theta + 0.1], None)
    state = fit.begin(theta)
    first, known = np.concatenate([state["theta"], state["log_sd"]]), FilterEngine.information
    lost: list[Array] = [first]

    def information(self: FilterEngine, at: Array, found: Filtered | None = None) -> Information:
        out = known(self, at, found)
        fails = any(np.array_equal(at, each) for each in lost)
        return replace(out, matrix=np.full_like(out.matrix, np.nan)) if fails else out

    monkeypatch.setattr(FilterEngine, "information", information)
    after = fit.step(state, 0).state
    assert len(after["waiting"]) == len(state["waiting"]) - 1
    assert not np.array_equal(np.concatenate([after["theta"], after["log_sd"]]), first)
    lost += [np.concatenate([each, first[len(each) :]]) for each in state["waiting"]] + list(state["waiting"])
    with pytest.raises(ComputationError):
        fit.step(state, 0)


GROWING = """model growing
time t from 0
state N in {} = 2
{}learn r = 0.8 in [0.1, 2]
N' = r*N*(1 - N/10)
diffusion N = 0.15*{}
observe N noise {}
"""


@pytest.mark.parametrize("learned", ["", "initial N learn\n"])
@pytest.mark.parametrize(
    ("bounds", "size", "noise", "first"),
    [
        ("[0, 20]", "N", "lognormal(0.02)", "0.5,0.36"),  # extended to the start, the curve is below zero
        ("[0, 20]", "N", "normal(0.1)", "0,0"),
        ("[0, 12]", "N*(12 - N)/12", "normal(0.1)", "0,-0.1"),
    ],
)
def test_starts_without_a_logarithm_or_logit_are_moved_inside(
    tmp_path: Path, learned: str, bounds: str, size: str, noise: str, first: str
) -> None:
    later = "1,0.508\n1.5,0.753\n2,1.138\n2.5,1.923\n3,2.863\n3.5,3.798\n4,4.027\n4.5,4.325\n5,6.604\n"
    text = GROWING.format(bounds, learned, size, noise)
    engine, vector = engine_of(tmp_path, text, f"t,N\n{first}\n{later}")
    assert np.isfinite(engine.value(vector))
