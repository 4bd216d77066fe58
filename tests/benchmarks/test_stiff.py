"""The stiff benchmark: equal errors, the same loss and gradient, its table."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import stiff
from benchmarks.stiff_workload import StiffWork, make
from benchmarks.variants import prepare_jax
from gbspec.training.engines.objective import objective


@pytest.fixture(scope="module", params=[None, 4])
def work(request: pytest.FixtureRequest) -> StiffWork:
    return make(request.param, trajectories=2, rows=8)


def test_the_tolerance_with_the_nearest_error_is_taken() -> None:
    errors = {1e-4: 1e-4, 1e-5: 2e-6, 1e-6: 3e-8, 1e-7: float("inf")}
    assert stiff.nearest(errors, 1e-6) == 1e-5
    with pytest.raises(ValueError, match="no tolerance"):
        stiff.nearest({1e-7: float("inf")}, 1e-6)


def test_the_ladder_ends_below_the_target() -> None:
    errors = stiff.ladder(lambda rtol: rtol, 1e-5)
    assert min(errors.values()) < 1e-5 / 20 < sorted(errors.values())[1]


def test_the_weights_of_the_workload_give_the_loss(work: StiffWork) -> None:
    exact = work.exact
    loss, _ = objective(work.controlled(1e-8), work.parameters, "native")(work.theta)
    assert (work.weight * (exact - work.value) ** 2).sum() == pytest.approx(loss, rel=1e-5)


def test_gradients_agree_at_about_the_target(work: StiffWork) -> None:
    pytest.importorskip("diffrax", reason="diffrax is not installed (`pip install .[benchmarks]`)")
    prepare_jax()
    found = stiff.measure(work, 1e-4, ("Kvaerno3",), 1, 1e9)["solvers"]
    assert set(found) == {stiff.OURS, "Kvaerno3"}
    for one in found.values():
        assert 3e-5 < one["error"] < 3e-4 and one["apart"] < stiff.AGREE


def test_sensitivities_by_cvodes_are_those_of_the_kernel(work: StiffWork) -> None:
    name = "CVODES adjoint" if work.layers else "CVODES forward"
    result = stiff.measure(work, 1e-4, (name,), 1, 1e9)
    assert set(result["solvers"]) == {stiff.OURS, name} and not result["failed"]
    for one in result["solvers"].values():
        assert 3e-5 < one["error"] < 3e-4 and one["apart"] < stiff.AGREE


def test_forward_sensitivities_of_many_weights_are_told_to_be_left_out(
    work: StiffWork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stiff, "FORWARD", 3)
    with pytest.raises(stiff.FailedError, match="not timed with"):
        stiff.maker(work, "CVODES forward")


def test_without_peers_the_own_time_is_told(work: StiffWork) -> None:
    try:
        found = stiff.measure(work, 1e-3, (), 2, 1e9)
    except ValueError as error:
        pytest.skip(str(error))
    text = stiff.table({"target": 1e-3, "trajectories": 2, "workloads": {"known": found}})
    lines = [line for line in text.splitlines() if line.startswith("| known")]
    assert {line.count("|") for line in text.splitlines() if line.startswith("| ")} == {9}
    assert len(lines) == 2 and "of it the choice of the steps" in lines[1]
    solver = found["solvers"][stiff.OURS]
    assert solver["planning"]["ms"] > 0 and np.isfinite(solver["error"])
