"""Starts: true ones against solutions by hand, spectra in the order of the truth's, and the tables of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gbspec import frontend
from gbspec.analysis.simulation.simulate import simulate, true_starts
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module.loader import load_module
from gbspec.data.sampling import SimulateOptions
from gbspec.diagnostics import Findings
from gbspec.passes.truth import with_truth
from gbspec.studies.member import Place, fit_member
from gbspec.studies.options import StudyOptions
from gbspec.studies.record import CaseSummary, Eigenvalues, EigenvaluesSummary, Extent, InitialStates
from gbspec.studies.start_tables import joined_eigenvalues, joined_states, sections
from gbspec.studies.starts import matched
from gbspec.studies.tasks import study_of

LINEAR = """\
model linear "Two modes"
state a in [0, 2] = 1
state b in [0, 2] = 1
learn k = 0.5 in [0.1, 2]
a' = -k*a
b' = -3*b
observe a
observe b
truth k = 0.7
"""


def test_true_starts_are_where_the_first_row_is(tmp_path: Path) -> None:
    (tmp_path / "linear.gb").write_text(LINEAR)
    known = with_truth(frontend.load_model(tmp_path / "linear.gb", Findings()))
    evaluator = Evaluator(load_module(known)())
    options = SimulateOptions(trajectories=5, span=2.0, dt=0.3, sampling="gamma", seed=3)
    measured, starts = simulate(evaluator, known, options), true_starts(evaluator, known, options)
    np.testing.assert_allclose([item.values[0] for item in measured.items], starts, rtol=1e-8)
    noisy = simulate(evaluator, known, replace(options, noise=0.5))
    assert [list(item.times) for item in noisy.items] == [list(item.times) for item in measured.items]
    kept = true_starts(evaluator, known, replace(options, keep_start=True, initial={"a": (1.5, 1.5), "b": (0.5, 0.5)}))
    assert kept == pytest.approx(np.tile([1.5, 0.5], (5, 1)))


def test_eigenvalues_stand_beside_the_nearest_true_ones() -> None:
    true = np.array([[-1.0 + 0j, -2.0 + 1j, -2.0 - 1j]])
    found = matched(np.array([[-2.1 - 1j, -2.1 + 1j, -0.9 + 0j]]), true)
    assert found.tolist() == [[-0.9 + 0j, -2.1 + 1j, -2.1 - 1j]]


def test_a_member_tells_of_its_starts_where_its_case_asks(cases: Path) -> None:
    cases.write_text(cases.read_text().replace("noise = 0.1", "sampling = 'gamma', channels = 'own-clock'"))
    (task,) = study_of([f"{cases}:TWO"], StudyOptions()).tasks()
    found = fit_member(task, Place(cases.parent / "out")).fitted
    assert found is not None and found.eigenvalues is not None and found.initial_states is not None
    spectra, starts = found.eigenvalues, found.initial_states
    # one state: the eigenvalue is the derivative of the right-hand side, -k - 0.6*N at the true start
    assert [imaginary for _, imaginary in spectra.true] == [0.0]
    assert -0.7 - 0.6 * 2 < spectra.true[0][0] < -0.7
    assert spectra.error[0] > 0
    assert starts.states["N"] == Extent(0, None, None)  # its first row measures it
    table = "\n".join(sections({"TWO": case(joined_eigenvalues([spectra]), joined_states([starts]))}))
    assert "## TWO: eigenvalues at the start" in table and "| N | 0 |  |  |" in table


def case(eigenvalues: EigenvaluesSummary | None, initial_states: dict[str, Extent] | None) -> CaseSummary:
    """A case of which nothing else is known."""
    rest: dict[str, Any] = dict.fromkeys(("model", "fit_of", "cpu_seconds"), None)
    rest |= {"title": "", "members": 1, "planned": 1, "effort": "normal", "noise": 0.0}
    rest |= {"failed": (), "step_warnings": (), "metrics": {}}
    return CaseSummary(**rest, eigenvalues=eigenvalues, initial_states=initial_states)


def test_members_are_joined_by_their_medians() -> None:
    def states(median: float) -> InitialStates:
        extent = Extent(2, median, 2 * median)
        return InitialStates({"N": extent}, extent, Extent(0, None, None))

    def spectra(error: float) -> Eigenvalues:
        return Eigenvalues("1", ((-1.0, 0.5),), ((-1.0, 0.4),), ((-1.0, 0.0),), (error,), (2 * error,))

    found = case(
        joined_eigenvalues([spectra(0.1), spectra(0.5), spectra(0.2)]),
        joined_states([states(1.0), states(3.0), states(2.0)]),
    )
    assert found.eigenvalues is not None and found.initial_states is not None
    assert (found.eigenvalues.error_at_true, found.eigenvalues.error) == ((0.2,), (0.4,))
    assert found.initial_states["N"] == Extent(6, 2.0, 6.0)
    text = "\n".join(sections({"C": found}))
    assert "| 1 | -1.00000 + 0.50000i | -1.00000 + 0.40000i | -1.00000 | 0.2 | 0.4 |" in text
    assert "| slow | 0 |  |  |" in text
    assert joined_eigenvalues([]) is None and joined_states([]) is None
