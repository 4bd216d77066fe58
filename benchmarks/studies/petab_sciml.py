"""How many cases of the PEtab-SciML test suite have the likelihood, gradient and simulations that the suite expects.

    python -m benchmarks.studies.petab_sciml SUITE -o docs/studies/petab_sciml.md

SUITE is a folder with a folder for each case (`petab/problem.yaml`, `solutions.yaml`), as the suite's own.
"""

from __future__ import annotations

import csv
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

import gbspec
from benchmarks.studies.suites import main, table
from gbspec.diagnostics import UserError
from gbspec.ir import Model


@dataclass(frozen=True)
class Outcome:
    """The end of a case; the largest errors of likelihood and simulations, and of the gradient, in tolerances."""

    case: str
    end: str
    said: tuple[str, ...] = ()
    value: float = 0.0
    gradient: float = 0.0
    derivatives: int = 0

    def cells(self) -> tuple[str, ...]:
        """Its errors."""
        return f"{self.value:.2g}", str(self.derivatives), f"{self.gradient:.2g}"


def judged(folder: Path) -> Outcome:
    """The end of one case."""
    from gbspec.operations import importing

    with tempfile.TemporaryDirectory() as place:
        try:
            made = importing.import_file(folder / "petab" / "problem.yaml", place)
            found = gbspec.evaluate(made.model, str(made.data))
            model = gbspec.load(made.model).model
        except UserError as error:
            said = tuple(one.message.replace(str(folder), folder.name) for one in error.diagnostics)
            return Outcome(folder.name, "refused", tuple(dict.fromkeys(said)))
    solution = yaml.safe_load((folder / "solutions.yaml").read_text())
    prior, by_prior = prior_of(model) if "log_posterior" in solution else (0.0, {})
    key = "log_posterior" if "log_posterior" in solution else "llh"
    errors = [abs(prior - found.nllh - solution[key]) / solution[f"tol_{key}"]]
    values = sorted(one.value for one in found.found.simulation)
    with (folder / solution["simulation_files"][0]).open() as file:
        expected = sorted(float(row["simulation"]) for row in csv.DictReader(file, delimiter="\t"))
    errors += [abs(a - b) / solution["tol_simulations"] for a, b in zip(values, expected, strict=True)]
    slopes, ours = gradient_of(folder, solution), found.gradient
    off = [
        abs(by_prior.get(name, 0.0) - ours.get(name, np.nan) - value) / solution["tol_grad"]
        for name, value in slopes.items()
    ]
    worst, steepest = float(np.max(errors)), float(np.max(off, initial=0.0))
    end = "passed" if worst <= 1 and steepest <= 1 else "wrong"
    return Outcome(folder.name, end, (), worst, steepest, len(off))


def prior_of(model: Model) -> tuple[float, dict[str, float]]:
    """The logarithm of the prior density at the starts, and its derivatives; without a prior it is uniform."""
    total, slopes = 0.0, {}
    for one in model.learnables:
        if one.prior is None:
            total -= np.log(one.range.high - one.range.low)
            continue
        mean, sd = one.prior.location, one.prior.scale
        total -= 0.5 * np.log(2 * np.pi * sd**2) + 0.5 * ((one.start - mean) / sd) ** 2
        slopes[one.name] = -(one.start - mean) / sd**2
    return total, slopes


def gradient_of(folder: Path, solution: dict[str, Any]) -> dict[str, float]:
    """The derivatives of the log likelihood by the names that the import gives to parameters and weights."""
    found: dict[str, float] = {}
    for network, name in solution["grad_files"].items():
        if name.endswith(".tsv"):
            with (folder / name).open() as file:
                found |= {r["parameterId"]: float(r["value"]) for r in csv.DictReader(file, delimiter="\t")}
            continue
        with h5py.File(folder / name) as file:
            for layer, kinds in file[f"parameters/{network}"].items():
                for kind, array in kinds.items():
                    for place, value in np.ndenumerate(array[()]):
                        found[f"{network}_{layer}_{kind}_" + "_".join(map(str, place))] = float(value)
    return found


def page(outcomes: list[Outcome]) -> str:
    passed = sum(one.end == "passed" for one in outcomes)
    lines = [
        "# The PEtab-SciML test suite",
        "",
        f"{len(outcomes)} cases of [PEtab-SciML](https://github.com/PEtab-dev/petab_sciml), of which {passed} pass,",
        "were imported (`gbspec import`) and evaluated at their nominal parameters (`gbspec evaluate`). The errors are",
        "the largest ones of log likelihood and simulations, and of the gradient by parameters and weights, in",
        "units of the suite's tolerances (033 states the posterior: the densities of the priors were added):",
        "",
        "    python -m benchmarks.studies.petab_sciml SUITE -o docs/studies/petab_sciml.md",
        "",
        *table(outcomes, "error", "derivatives", "their error"),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(__doc__, "*", judged, page)
