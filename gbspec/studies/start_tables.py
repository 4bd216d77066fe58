"""The tables on initial states: eigenvalues there, as in the paper, and the errors of learned initial states."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

from gbspec.json_values import JsonObject

SPECTRA = ("true", "learned_at_true", "learned")


def joined(records: Sequence[JsonObject]) -> JsonObject:
    """The summary over the members of a case about initial states; empty if the case requests none.

    Spectra are those of the first member; distances and differences are the median over members of the members'
    medians, and the largest over members.
    """
    found: JsonObject = {}
    spectra = [record["eigenvalues"] for record in records if "eigenvalues" in record]
    if spectra:
        first = {name: spectra[0][name] for name in ("trajectory", *SPECTRA)}
        errors = {
            name: [statistics.median(column) for column in zip(*(one[name] for one in spectra), strict=True)]
            for name in ("error_at_true", "error")
        }
        found["eigenvalues"] = {"members": len(spectra), **first, **errors}
    starts = [record["initial_states"] for record in records if "initial_states" in record]
    if starts:
        rows = {name: [one["states"][name] for one in starts] for name in starts[0]["states"]}
        rows |= {name: [one[name] for one in starts] for name in ("fast", "slow")}
        found["initial_states"] = {name: _together(several) for name, several in rows.items()}
    return found


def _together(several: Sequence[JsonObject]) -> JsonObject:
    learned = [one for one in several if one["n"]]
    if not learned:
        return {"n": 0, "median": None, "worst": None}
    return {
        "n": sum(one["n"] for one in learned),
        "median": statistics.median(one["median"] for one in learned),
        "worst": max(one["worst"] for one in learned),
    }


def sections(cases: Mapping[str, JsonObject]) -> list[str]:
    """The lines of `table.md` on initial states, for the cases that have them."""
    lines: list[str] = []
    for name, case in cases.items():
        if "eigenvalues" in case:
            lines += _eigenvalues(name, case["eigenvalues"])
        if "initial_states" in case:
            lines += _initial_states(name, case["initial_states"])
    return lines


def _eigenvalues(case: str, found: JsonObject) -> list[str]:
    lines = [
        "",
        f"## {case}: eigenvalues at the start",
        "",
        f"Eigenvalues of the first member at the start of trajectory {found['trajectory']}, and their distances to the "
        "true ones in the complex plane (median over trajectories, then over "
        f"{found['members']} members). Each column names the Jacobian and the initial state at which it is taken.",
        "",
        "| | true, true start | learned, true start | learned, learned start "
        "| distance, true start | distance, learned start |",
        "|---|---|---|---|---|---|",
    ]
    for rank, values in enumerate(zip(*(found[name] for name in SPECTRA), strict=True)):
        shown = [_complex(*value) for value in values]
        distances = [f"{found[name][rank]:.2g}" for name in ("error_at_true", "error")]
        lines.append("| " + " | ".join([str(rank + 1), *shown, *distances]) + " |")
    return lines


def _complex(real: float, imaginary: float) -> str:
    sign = "+" if imaginary > 0 else "-"
    return f"{real:.5f}" + (f" {sign} {abs(imaginary):.5f}i" if imaginary else "")


def _initial_states(case: str, found: Mapping[str, JsonObject]) -> list[str]:
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
        numbers = ["" if one[key] is None else f"{one[key]:.3g}" for key in ("median", "worst")]
        lines.append("| " + " | ".join([name, str(one["n"]), *numbers]) + " |")
    return lines
