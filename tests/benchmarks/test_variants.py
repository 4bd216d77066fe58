"""All variants compute the same loss and gradient; disagreement is detected before timing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import growth, step
from benchmarks.variants import VARIANTS, Candidate, DisagreementError, agree, build, compare, reference
from benchmarks.workload import Size, Workload, make

LIBRARIES = {"jax": "jax", "numba": "numba", "torchdiffeq": "torchdiffeq"}


@pytest.fixture(scope="module")
def work() -> Workload:
    return make(Size(trajectories=3, span=2.0))


def test_the_workload_is_packed_as_it_was_measured(work: Workload) -> None:
    packed = work.problem.packed
    assert work.measured == int((packed.weights > 0).sum()) == packed.rows  # one channel per key time
    assert work.substeps == packed.substeps
    assert work.interval.sum() == pytest.approx(work.h.sum())
    assert work.count.sum() == work.substeps
    assert work.flop == 3 * 2 * 4 * work.substeps * (3 * 64 + 64 * 64 + 64)
    assert np.all(work.h <= 0.1 + 1e-12)


# the others take long to compile if they are installed; the command compares all of them with the reference
@pytest.mark.parametrize("name", [name for name in VARIANTS if name not in ("jax", "diffrax", "diffrax-scan")])
def test_a_variant_agrees_with_the_generated_module(name: str, work: Workload) -> None:
    library = LIBRARIES.get(name.partition("-")[0])
    if library is not None:
        pytest.importorskip(library, reason=f"{library} is not installed (`pip install .[benchmarks]`)")
    dtypes = ("float64",) if library in ("jax", "numba") else VARIANTS[name].dtypes
    told: list[str] = []
    made = build(work, [name], dtypes, told.append)
    if name.startswith("native") and not made:
        pytest.skip(told[0])
    assert [candidate.dtype for candidate in made] == list(dtypes)
    agree(work, made, told.append)
    assert len(told) == len(made)


def test_a_wrong_gradient_is_detected(work: Workload) -> None:
    candidate = Candidate("torch", "float64", VARIANTS["torch"].build(work, "float64"))
    expected = reference(work)
    compare(candidate, candidate.gradient(work), expected)
    loss, gradient = candidate.gradient(work)
    gradient[7] += 1e-6 * np.linalg.norm(gradient)
    with pytest.raises(DisagreementError, match="torch float64 is"):
        compare(candidate, (loss, gradient), expected)
    with pytest.raises(DisagreementError):
        compare(candidate, (loss * (1 + 1e-6), expected[1]), expected)
    other = replace(work, h=1.01 * work.h)
    wrong = Candidate("torch", "float64", VARIANTS["torch"].build(other, "float64"))
    with pytest.raises(DisagreementError):
        agree(work, [wrong])


def test_a_missing_library_is_reported(work: Workload, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(VARIANTS, "torchdiffeq", replace(VARIANTS["torchdiffeq"], module="benchmarks.peers.none"))
    told: list[str] = []
    assert build(work, ["torchdiffeq"], ["float32", "float64"], told.append) == []
    assert len(told) == 1 and "skipped" in told[0] and "pip install .[benchmarks]" in told[0]


def test_a_step_is_measured_against_the_limit(work: Workload) -> None:
    candidates = build(work, ["torch", "graph"], ["float32", "float64"])
    result = step.measure(work, candidates, 2, 1e9)
    assert set(result["timings"]) == {"torch float32", "torch float64", "graph float32", "graph float64"}
    assert all(value > 0 for value in result["limit_ms"].values())
    shape = {"trajectories": 3, "measured": work.measured, "substeps": work.substeps, "flop": work.flop}
    text = step.table(result | {"memory_mb": {"torch": 1.25, "graph": None}, "rounds": 2, "workload": shape})
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 3
    ratio = result["timings"]["torch float64"]["ms"] / result["limit_ms"]["float64"]
    assert any(f" {ratio:.2f} |" in row and "written well" in row and row.endswith(" 1.2 |") for row in rows)


def test_peak_memory_grows_with_what_is_stored() -> None:
    size = Size(trajectories=40, span=4.0)
    found = step.memory_of("torch", "float32", size)
    if found is None:
        pytest.skip("this kernel does not tell the peak of memory")
    stored = 4 * 2 * 64 * 4 * make(size, 20).substeps / 2**20  # outputs of both layers in four Runge-Kutta stages
    assert stored < found < 6 * stored


def test_growth_skips_cases_that_would_take_too_long() -> None:
    size = Size(trajectories=3, span=1.0, width=8, states=4)
    found = growth.case(size, ["torch", "graph"], {"torch": 1.0}, 1, 6.0)
    assert set(found["timings"]) == {"graph"}
    assert set(found["left_out"]) == {"torch"}
    text = growth.table({"states": [found]}, ["torch", "graph"])
    assert text.splitlines()[-1].startswith("| states 4 |") and " s a step |" in text


def test_trajectories_beyond_those_simulated_are_repeats() -> None:
    work = make(Size(trajectories=5, span=1.0), simulated=2)
    assert work.problem.packed.trajectories == 5
    assert np.array_equal(work.h[:, 0], work.h[:, 4])
    assert not np.array_equal(work.h[:, 0], work.h[:, 1])
    with torch.no_grad():
        candidate = Candidate("torch", "float64", VARIANTS["torch"].build(work, "float64"))
    compare(candidate, candidate.gradient(work), reference(work))
