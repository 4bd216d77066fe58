"""The bundled models: in form, without findings, simulated as their cases say, right where numbers are published."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from gbspec.analysis.simulation.simulate import simulate
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module.loader import load_module
from gbspec.data.cases import find_cases
from gbspec.data.fingerprints import fingerprint
from gbspec.data.shipped import models_folder, shipped_model, shipped_models
from gbspec.data.table import read, write
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.passes.override import with_values
from gbspec.passes.truth import with_truth
from gbspec.syntax.formatter import format_text

NAMES = tuple(shipped_models())
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


@cache
def model(name: str) -> Model:
    findings = Findings()
    loaded = load_model(shipped_model(name), findings)
    assert list(findings) == []
    return loaded


TRUE = tuple(name for name in NAMES if model(name).has_truth and not model(name).complete)


@cache
def truth(name: str) -> tuple[Model, Evaluator]:
    known = with_truth(model(name))
    return known, Evaluator(load_module(known)())


def shared(name: str) -> Path:
    path = SHARED / f"{name}.csv"
    if not path.is_file():
        pytest.skip(f"{name}.csv is not there: the shared tables are not part of the project")
    return path


# ---------------------------------------------------------------------------------------------------------- text


@pytest.mark.parametrize("name", NAMES)
def test_a_model_is_in_form_and_without_findings(name: str) -> None:
    path = shipped_model(name)
    text = path.read_text(encoding="utf-8")
    assert format_text(Source(str(path), text)) == text
    loaded = model(name)
    assert loaded.name == name == path.stem
    assert loaded.title and loaded.channels
    assert all(state.description and state.range is not None for state in loaded.states)


def test_several_fields_and_every_kind_of_statement_are_shown() -> None:
    models = [model(name) for name in NAMES]
    assert len({path.parent for path in shipped_models().values()}) >= 6
    assert {i.interpolation for m in models for i in m.inputs} == {"held", "linear"}
    assert any(m.processes for m in models) and any(m.conditions for m in models)
    assert any(u.postulate != m.unknowns[0].postulate or u.neutral for m in models for u in m.unknowns)
    assert any(s.initial.kind == "expression" for m in models for s in m.states)
    assert len(TRUE) >= 10


def test_the_papers_networks_have_its_sizes() -> None:
    for name, inputs, hidden, outputs in (
        ("urp_bb", 3, (64, 64), 2),
        ("urp_gb1", 3, (64, 64), 1),
        ("urp_gb2", 3, (64, 64), 1),
        ("bf_bb", 6, (32, 32), 6),
        ("bf_gb1", 6, (32, 32), 3),
        ("bf_gb2", 6, (32, 32), 3),
    ):
        (network,) = model(name).networks
        assert (len(network.arguments), network.hidden, len(network.outputs)) == (inputs, hidden, outputs)
        assert network.activation == "silu"


# ---------------------------------------------------------------------------------------------------------- cases


@pytest.mark.parametrize("folder", sorted({path.parent.name for path in shipped_models().values()}))
def test_every_case_fits_its_model(folder: str) -> None:
    from gbspec.training.options import TrainOptions

    known = {field.name for field in dataclasses.fields(TrainOptions)}
    paths = [path for path in shipped_models().values() if path.parent.name == folder]
    cases = find_cases(paths[0])
    assert cases.path is not None and cases.path.parent == models_folder() / folder
    for case in (*cases.cases, *(cases.of_model(path.stem) for path in paths)):
        where = [case.model] if case.model else paths
        for path in where:
            fits = model(path.stem)
            assert set(case.metrics.scales) <= {s.name for s in fits.states}
            assert set(case.sampling.clock) <= {c.name for c in fits.channels}
            if fits.has_truth and case.model:
                assert set(case.sampling.initial) <= {s.name for s in fits.states}
        assert set(case.training.more) <= known
        assert set(case.published) <= {"solution", "rhs", "functions", "constants"}


def test_all_cases_of_the_paper_are_there() -> None:
    names = {case.name for model in ("urp_bb", "bf_bb") for case in find_cases(shipped_model(model)).cases}
    assert names >= {*"ABCDEF", "URP_BB", "URP_GB1", "URP_GB2", "BF_BB", "BF_GB1", "BF_GB2"}
    assert names >= {f"BF_BB_{letter}" for letter in "ABCDE"}


@pytest.mark.parametrize("name", TRUE)
def test_a_model_is_simulated_as_its_case_says(name: str, tmp_path: Path) -> None:
    known, evaluator = truth(name)
    options = find_cases(shipped_model(name)).of_model(name).sampling
    made = simulate(evaluator, known, dataclasses.replace(options, trajectories=8))
    assert made.meta["failed"] == "0"
    path = tmp_path / "t.csv"
    write(path, made, known)
    findings = Findings()
    back = read(path, model(name), findings)
    assert list(findings) == []  # everything within its declared range
    assert [fingerprint(item) for item in back.items] == [fingerprint(item) for item in made.items]
    assert all(len(item.times) >= 5 for item in made.items)


@pytest.mark.parametrize("name", ["bf_gb1", "friction_oscillator", "fed_batch", "lotka_volterra", "one_compartment"])
def test_defaults_alone_simulate_too(name: str) -> None:
    from gbspec.data.sampling import SimulateOptions

    known, evaluator = truth(name)
    made = simulate(evaluator, known, SimulateOptions(trajectories=3))
    assert len(made) == 3 and all(len(item.times) == 20 for item in made.items)


@pytest.mark.parametrize("names", [("urp_bb", "urp_gb1", "urp_gb2"), ("bf_bb", "bf_gb1", "bf_gb2")])
def test_black_and_gray_boxes_have_the_same_truth(names: tuple[str, ...]) -> None:
    random = np.random.default_rng(0)
    known, _ = truth(names[0])
    low, high = np.array([(s.range.low, s.range.high) for s in known.states if s.range is not None]).T
    states = low + (high - low) * random.random((200, len(low)))
    conditions = 0.2 + 0.3 * random.random((200, len(known.conditions)))
    expected = truth(names[0])[1].rhs_many(0.0, states, conditions)
    for name in names[1:]:
        np.testing.assert_allclose(truth(name)[1].rhs_many(0.0, states, conditions), expected, rtol=1e-12, atol=1e-9)


# ------------------------------------------------------------------------------------------------ published numbers


@pytest.mark.parametrize("Da", [0.2802749000, 0.4195478413])
def test_the_reactor_has_its_hopf_points(Da: float) -> None:
    """Where the trace of the Jacobian vanishes at the steady state (Uppal, Ray and Poore 1974; B = 11, beta = 3)."""
    _, evaluator = truth("urp_gb2")
    # At rest phi = x1, and then x2*(1 + beta) = B*x1.
    x1 = brentq(lambda x: evaluator.rhs_many(0.0, [[x, 11 * x / 4]], [Da])[0, 0], 0.3, 0.95, xtol=1e-14)
    state = [x1, 11 * x1 / 4]
    np.testing.assert_allclose(evaluator.rhs_many(0.0, [state], [Da]), 0, atol=1e-11)
    jacobian = evaluator.jacobian_at(0.0, state, [Da])
    assert np.trace(jacobian) == pytest.approx(0, abs=1e-6)
    assert np.linalg.det(jacobian) > 0


@pytest.mark.parametrize(("Da", "period", "top"), [(0.30, 3.00175874, 3.46358205), (0.40, 2.09337028, 2.80983466)])
def test_the_reactor_has_its_cycles(Da: float, period: float, top: float) -> None:
    _, evaluator = truth("urp_gb2")
    settled = evaluator.integrate([0.6, 2.0], [300.0], [Da], start=0.0)[-1]
    times = np.linspace(0.0, 3 * period, 6001)
    path = evaluator.integrate(settled, times, [Da], start=0.0)[:, 1]
    assert peaks(times, path)[0] == pytest.approx(period, rel=1e-5)
    assert peaks(times, path)[1] == pytest.approx(top, rel=1e-5)


@pytest.mark.parametrize(("name", "period"), [("bf_gb2", 202.3407), ("bf_printed", 218.237)])
def test_the_three_species_have_their_cycle(name: str, period: float) -> None:
    _, evaluator = truth(name)
    settled = evaluator.integrate([50, 0.5, 0.3, 100, 1000, 0.7], [8000.0], start=0.0)[-1]
    times = np.linspace(0.0, 2.5 * period, 20_001)
    path = evaluator.integrate(settled, times, start=0.0)[:, 0]
    assert peaks(times, path)[0] == pytest.approx(period, rel=1e-4)


def test_the_three_species_have_the_published_eigenvalue() -> None:
    """One mode decays with the dilution rate, at -0.20145 everywhere."""
    _, evaluator = truth("bf_gb2")
    state = [4.3034, 0.0, 1.58805, 100.603, 570.946, 0.74246]
    found = np.linalg.eigvals(evaluator.jacobian_at(0.0, state))
    assert np.min(abs(found + 1 / (7.3 * 0.68))) < 1e-9
    assert pytest.approx(0.20145, abs=5e-6) == 1 / (7.3 * 0.68)


def peaks(times: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """The distance of the first two highest points of a cycle, and their height, by parabolas through three points."""
    inner = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1
    inner = inner[values[inner] > 0.9 * values.max()]
    tops, heights = [], []
    for i in inner[:2]:
        a, b, c = np.polyfit(times[i - 1 : i + 2] - times[i], values[i - 1 : i + 2], 2)
        tops.append(times[i] - b / (2 * a))
        heights.append(c - b**2 / (4 * a))
    return tops[1] - tops[0], heights[0]


# -------------------------------------------------------------------------------------------------- shared tables

FITS: Mapping[str, tuple[float, dict[str, float]]] = {
    "alpha_pinene": (
        19.872,
        {"p1": 5.92585e-5, "p2": 2.963402e-5, "p3": 2.047282e-5, "p4": 2.744678e-4, "p5": 3.997950e-5},
    ),
    "gas_oil": (0.0052366, {"k1": 11.84674, "k2": 8.344519, "k3": 1.001441}),
    "methanol": (0.00904, {"a1": 1.77393, "a2": 2.167307, "a3": 1.858916, "a4": 1.801998, "a5": 0.001575}),
}
"""Sums of squares that the literature gives, and constants that reach them."""


@pytest.mark.parametrize("name", FITS)
def test_known_constants_reach_the_published_sum_of_squares(name: str) -> None:
    path = shared(name)
    expected, constants = FITS[name]
    fitted = with_truth(with_values(model(name), constants))
    evaluator = Evaluator(load_module(fitted)())
    findings = Findings()
    (item,) = read(path, fitted, findings).items
    assert list(findings) == []
    start = evaluator.initial(np.full(len(fitted.states), np.nan), item.condition)
    states = evaluator.integrate(start, item.times, item.condition, start=item.start)
    residual = evaluator.observe_many(item.times, states) - item.values
    assert np.nansum(residual**2) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize(
    ("table", "name", "trajectories", "values"),
    [
        ("hare_lynx", "hare_lynx", 1, 42),
        ("algae_rotifers", "algae_rotifers", 1, 216),
        ("theophylline", "theophylline", 12, 132),
        ("alpha_pinene", "alpha_pinene", 1, 40),
        ("gas_oil", "gas_oil", 1, 42),
        ("methanol", "methanol", 1, 51),
    ],
)
def test_shared_tables_are_read_without_findings(table: str, name: str, trajectories: int, values: int) -> None:
    findings = Findings()
    found: Trajectories = read(shared(table), model(name), findings)
    assert list(findings) == []
    assert (len(found), found.measurements) == (trajectories, values)
