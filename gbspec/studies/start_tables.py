"""The tables on initial states: eigenvalues there, as in the paper, and the errors of learned initial states."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

from gbspec.studies.record import CaseSummary, Eigenvalues, EigenvaluesSummary, Extent, InitialStates


def joined_eigenvalues(several: Sequence[Eigenvalues]) -> EigenvaluesSummary | None:
    """Spectra of the first member, and distances as the median over members of the members' medians."""
    if not several:
        return None
    first = several[0]
    return EigenvaluesSummary(
        len(several),
        first.trajectory,
        first.true,
        first.learned_at_true,
        first.learned,
        _medians([one.error_at_true for one in several]),
        _medians([one.error for one in several]),
    )


def _medians(rows: Sequence[Sequence[float]]) -> tuple[float, ...]:
    return tuple(statistics.median(column) for column in zip(*rows, strict=True))


def joined_states(several: Sequence[InitialStates]) -> dict[str, Extent] | None:
    """Errors of initial states: the median over members of the members' medians, and the largest over members."""
    if not several:
        return None
    rows = {name: [one.states[name] for one in several] for name in several[0].states}
    rows |= {"fast": [one.fast for one in several], "slow": [one.slow for one in several]}
    return {name: _together(extents) for name, extents in rows.items()}


def _together(several: Sequence[Extent]) -> Extent:
    medians = [one.median for one in several if one.median is not None]
    worst = [one.worst for one in several if one.worst is not None]
    if not medians or not worst:
        return Extent(0, None, None)
    return Extent(sum(one.n for one in several), statistics.median(medians), max(worst))


def sections(cases: Mapping[str, CaseSummary]) -> list[str]:
    """The lines of `table.md` on initial states, for the cases that have them."""
    lines: list[str] = []
    for name, case in cases.items():
        if case.eigenvalues is not None:
            lines += _eigenvalues(name, case.eigenvalues)
        if case.initial_states is not None:
            lines += _initial_states(name, case.initial_states)
    return lines


def _eigenvalues(case: str, found: EigenvaluesSummary) -> list[str]:
    lines = [
        "",
        f"## {case}: eigenvalues at the start",
        "",
        f"Eigenvalues of the first member at the start of trajectory {found.trajectory}, and their distances to the "
        "true ones in the complex plane (median over trajectories, then over "
        f"{found.members} members). Each column names the Jacobian and the initial state at which it is taken.",
        "",
        "| | true, true start | learned, true start | learned, learned start "
        "| distance, true start | distance, learned start |",
        "|---|---|---|---|---|---|",
    ]
    for rank, values in enumerate(zip(found.true, found.learned_at_true, found.learned, strict=True)):
        shown = [_complex(*value) for value in values]
        distances = [f"{errors[rank]:.2g}" for errors in (found.error_at_true, found.error)]
        lines.append("| " + " | ".join([str(rank + 1), *shown, *distances]) + " |")
    return lines


def _complex(real: float, imaginary: float) -> str:
    sign = "+" if imaginary > 0 else "-"
    return f"{real:.5f}" + (f" {sign} {abs(imaginary):.5f}i" if imaginary else "")


def _initial_states(case: str, found: Mapping[str, Extent]) -> list[str]:
    lines = [
        "",
        f"## {case}: learned initial states",
        "",
        "Distance between learned and true initial values, in standard deviations of the true ones, where the state "
        "was not measured at the start; also along the fast directions (which decay before the next measurement) and "
        "the slow ones.",
        "",
        "| | n | median | worst |",
        "|---|---|---|---|",
    ]
    for name, one in found.items():
        numbers = ["" if value is None else f"{value:.3g}" for value in (one.median, one.worst)]
        lines.append("| " + " | ".join([name, str(one.n), *numbers]) + " |")
    return lines
