"""How many cases of the PEtab test suite have the likelihood that the suite expects.

    python -m benchmarks.studies.petab SUITE -o docs/studies/petab.md

SUITE has the folders `v1` and `v2`, with a folder for each case (`_NNNN.yaml`, its tables, `_NNNN_solution.yaml`), as
the suite's own.
"""

from __future__ import annotations

import csv
import tempfile
from dataclasses import dataclass
from pathlib import Path

import yaml

import gbspec
from benchmarks.studies.suites import main, table
from gbspec.diagnostics import ComputationError, UserError


@dataclass(frozen=True)
class Outcome:
    case: str
    end: str
    said: tuple[str, ...] = ()
    error: float = 0.0

    def cells(self) -> tuple[str, ...]:
        """The error."""
        return (f"{self.error:.2g}",)


def judged(folder: Path) -> Outcome:
    """The end of one case: the largest of the errors of chi2, log likelihood and simulations, in their tolerances."""
    from gbspec.operations import importing

    name, case = folder.name, f"{folder.parent.name}/{folder.name}"
    with tempfile.TemporaryDirectory() as place:
        try:
            made = importing.import_file(folder / f"_{name}.yaml", place)
            found = gbspec.evaluate(made.model, str(made.data))
        except UserError as error:
            return Outcome(case, "refused", tuple(dict.fromkeys(one.message for one in error.diagnostics)))
        except ComputationError as error:
            return Outcome(case, "failed", (str(error),))
    solution = yaml.safe_load((folder / f"_{name}_solution.yaml").read_text())
    errors = [
        abs(found.chi2 - solution["chi2"]) / solution["tol_chi2"],
        abs(-found.nllh - solution["llh"]) / solution["tol_llh"],
    ]
    values = sorted(one.value for one in found.found.simulation)
    with (folder / solution["simulation_files"][0]).open() as file:
        expected = sorted(float(row["simulation"]) for row in csv.DictReader(file, delimiter="\t"))
    errors += [abs(a - b) / solution["tol_simulations"] for a, b in zip(values, expected, strict=True)]
    worst = max(errors)
    return Outcome(case, "passed" if worst <= 1 else "wrong", (), worst)


def page(outcomes: list[Outcome]) -> str:
    lines = [
        "# The PEtab test suite",
        "",
        f"{len(outcomes)} cases of [PEtab 1 and 2](https://github.com/PEtab-dev/petab_test_suite), of which",
        f"{sum(one.end == 'passed' for one in outcomes)} pass, were imported (`gbspec import`) and evaluated at their "
        "nominal parameters (`gbspec evaluate`). The error is the",
        "largest one of chi2, log likelihood and simulations, in units of the suite's tolerance:",
        "",
        "    python -m benchmarks.studies.petab SUITE -o docs/studies/petab.md",
        "",
        *table(outcomes, "error"),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(__doc__, "v[12]/*", judged, page)
