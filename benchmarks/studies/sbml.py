"""How many time courses of the SBML semantic test suite are reproduced, and why the others are not imported.

    python -m benchmarks.studies.sbml SUITE -o docs/studies/sbml.md

SUITE is a folder with a folder for each case (`model.xml`, `settings.txt`, `results.csv`), as the suite's own.
"""

from __future__ import annotations

import argparse
import collections
import csv
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gbspec
from gbspec.diagnostics import ComputationError, UserError


@dataclass(frozen=True)
class Outcome:
    """The end of a case: `passed`, `refused`, `failed` (no solution) or `wrong`, with what was said, and the error in
    units of the tolerance."""

    case: str
    end: str
    said: tuple[str, ...] = ()
    error: float = 0.0


def settings_of(folder: Path) -> dict[str, str]:
    lines = (folder / "settings.txt").read_text().splitlines()
    return {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines) if key.strip()}


def simulated(path: Path, duration: float, steps: int) -> dict[str, np.ndarray]:
    """The channels and constants of an imported model by name, at the suite's times."""
    model = gbspec.load(path)
    made = model.simulate(trajectories=1, span=duration, dt=duration / steps, sampling="regular", keep_start=True)
    item = made.items[0]
    found = {c.column or c.name: item.values[:, i] for i, c in enumerate(model.model.channels)}
    constants = {c.name: np.full(len(item.times), c.value) for c in model.model.constants}
    spelled = {name.rstrip("_"): values for name, values in constants.items()}  # `pi` is written `pi_`
    return {"time": item.times, **spelled, **constants, **found}


def columns_of(folder: Path, found: dict[str, np.ndarray], asked: list[str], kinds: dict[str, str]) -> list[np.ndarray]:
    """The asked variables as amounts or concentrations; symbols have the one that SBML's formulas use."""
    import libsbml

    model = libsbml.readSBMLFromFile(str(folder / "model.xml")).getModel()
    out = []
    for name in asked:
        values, species = found[name], model.getSpecies(name)
        if species is not None:
            size = found.get(species.getCompartment())
            compartment = model.getCompartment(species.getCompartment())
            amount = species.getHasOnlySubstanceUnits() or compartment.getSpatialDimensionsAsDouble() == 0
            if kinds.get(name) == "amount" and not amount:
                values = values * size
            elif kinds.get(name) == "concentration" and species.getHasOnlySubstanceUnits():
                values = values / size
        out.append(values)
    return out


def judged(folder: Path) -> Outcome:
    """The end of one case."""
    from gbspec.operations import importing

    with tempfile.TemporaryDirectory() as place:
        try:
            made = importing.import_file(folder / "model.xml", place)
        except UserError as error:
            return Outcome(folder.name, "refused", tuple(dict.fromkeys(one.message for one in error.diagnostics)))
        settings = settings_of(folder)
        start, duration = float(settings["start"]), float(settings["duration"])
        with (folder / "results.csv").open() as file:
            rows = list(csv.reader(file))
        asked = [name.strip() for name in rows[0][1:]]
        expected = np.array([[float(x) for x in row[1:]] for row in rows[1:] if row])
        kinds = {name.strip(): kind for kind in ("amount", "concentration") for name in settings[kind].split(",")}
        steps = round(int(settings["steps"]) * (start + duration) / duration)
        try:
            found = simulated(Path(made.model), start + duration, steps)
            values = np.stack(columns_of(folder, found, asked, kinds), axis=1)[-len(expected) :]
        except (UserError, ComputationError) as error:
            return Outcome(folder.name, "failed", (str(error),))
        except KeyError as error:
            return Outcome(folder.name, "failed", (f"no column {error}",))
    allowed = float(settings["absolute"]) + float(settings["relative"]) * np.abs(expected)
    same = (values == expected) | (np.isnan(values) & np.isnan(expected))
    with np.errstate(invalid="ignore"):
        errors = np.where(same, 0.0, np.abs(values - expected) / allowed)
    worst = float(np.nanmax(np.where(np.isnan(errors), np.inf, errors)))
    return Outcome(folder.name, "passed" if worst <= 1 else "wrong", (), worst)


def reason_of(said: str) -> str:
    """A refusal without the names in it, so that equal ones are counted."""
    return said.rpartition(": ")[2] if ": " in said else said


def page(outcomes: list[Outcome], seconds: float) -> str:
    counts = collections.Counter(one.end for one in outcomes)
    reasons: dict[str, list[str]] = collections.defaultdict(list)
    for one in outcomes:
        if one.end == "refused":
            for reason in dict.fromkeys(map(reason_of, one.said)):
                reasons[reason].append(one.case)
    lines = [
        "# The SBML test suite",
        "",
        f"{len(outcomes)} core time courses of the "
        "[SBML semantic test suite](https://github.com/sbmlteam/sbml-test-suite)",
        "were imported (`gbspec import`), simulated as `gbspec simulate` does, and compared with the suite's results",
        "at its tolerances:",
        "",
        "    python -m benchmarks.studies.sbml SUITE -o docs/studies/sbml.md",
        "",
        "| outcome | cases |",
        "|---|---:|",
        f"| every value within the suite's tolerance | {counts['passed']} |",
        f"| refused, with all reasons | {counts['refused']} |",
        f"| imported, but without a solution to the end | {counts['failed']} |",
        f"| **wrong values** | **{counts['wrong']}** |",
        "",
        f"It took {seconds:.0f} s in two processes. A case can have several reasons for which it is refused:",
        "",
        "| reason | cases |",
        "|---|---:|",
        *(f"| {reason} | {len(cases)} |" for reason, cases in sorted(reasons.items(), key=lambda x: -len(x[1]))),
    ]
    refused = [one for one in outcomes if one.end == "refused"]
    lines += ["", "## Cases that are refused", "", *(f"- {one.case}: {'; '.join(one.said)}" for one in refused)]
    for end in ("failed", "wrong"):
        bad = [one for one in outcomes if one.end == end]
        lines += ["", f"## Cases that {'have no solution' if end == 'failed' else 'are wrong'}", ""] if bad else []
        lines += [f"- {one.case}: {'; '.join(one.said) or f'{one.error:.3g} times the tolerance'}" for one in bad]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", type=Path)
    parser.add_argument("-o", dest="out", type=Path)
    parser.add_argument("--case", nargs="*", default=None)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    folders = [f for f in sorted(given.suite.iterdir()) if f.is_dir() and (not given.case or f.name in given.case)]
    begun = time.perf_counter()
    with ProcessPoolExecutor(given.workers) as pool:
        outcomes = list(pool.map(judged, folders, chunksize=4))
    if given.out is not None:
        given.out.write_text(page(outcomes, time.perf_counter() - begun), encoding="utf-8")
    for one in outcomes:
        if given.out is None or one.end in ("failed", "wrong"):
            print(one.case, one.end, f"{one.error:.3g}", *one.said)
    print(collections.Counter(one.end for one in outcomes), f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
