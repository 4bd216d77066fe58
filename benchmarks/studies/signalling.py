"""A signalling model written as PEtab files from a known truth: imported, fitted by defaults, and compared with the
optimum that an independent program finds from the truth.

    python -m benchmarks.studies.signalling WORK -o docs/studies/signalling.md

A cascade of four proteins, each active or not (8 states), with a feedback of the last on the third; 9 rate constants,
three doses of a ligand, the four active forms measured with normal noise. The independent program is scipy: LSODA at
1e-10 and `least_squares` over logarithms of the constants, from the truth; it shares no code with gbspec.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path

import libsbml
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import gbspec
from gbspec.arrays import Array
from gbspec.operations.importing import import_file

TRUTH = {"k1": 1.0, "k2": 0.4, "k3": 2.0, "k4": 0.6, "k5": 3.0, "k6": 0.5, "k7": 1.0, "k8": 0.2, "k9": 4.0}
LOWER, UPPER = 1e-3, 1e3
"""The bounds of all constants."""
PAIRS = ("R", "M", "E", "X")
DOSES = {"low": 0.1, "middle": 0.5, "high": 2.0}
TIMES = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
SD = 0.02
LAWS = {
    "R": ("k1*L*R", "k2*Ra"),
    "M": ("k3*Ra*M", "k4*Ma"),
    "E": ("k5*Ma*E/(1 + k9*Xa)", "k6*Ea"),
    "X": ("k7*Ea*X", "k8*Xa"),
}
"""The rates at which each protein becomes active, and inactive again."""


# ------------------------------------------------------------------------------------------------ independent program
def slopes(x: Array, k: Sequence[float], dose: float) -> list[float]:
    """The derivatives of the four active forms; the totals are 1."""
    a, m, e, f = x
    return [
        k[0] * dose * (1 - a) - k[1] * a,
        k[2] * a * (1 - m) - k[3] * m,
        k[4] * m * (1 - e) / (1 + k[8] * f) - k[5] * e,
        k[6] * e * (1 - f) - k[7] * f,
    ]


def solved(k: Sequence[float]) -> Array:
    """The active forms [doses, times, 4]."""
    found = []
    for dose in DOSES.values():
        made = solve_ivp(
            lambda t, x, dose=dose: slopes(x, k, dose), (0, TIMES[-1]), np.zeros(4), "LSODA", TIMES, rtol=1e-10,
            atol=1e-12,
        )  # fmt: skip
        found.append(made.y.T)
    return np.array(found)


def independent(values: Array) -> tuple[float, Array]:
    """The negative log likelihood at the optimum that is found from the truth, and the constants there."""

    def residuals(logs: Array) -> Array:
        return ((solved(np.exp(logs).tolist()) - values) / SD).ravel()

    found = least_squares(residuals, np.log(list(TRUTH.values())), xtol=1e-12, ftol=1e-12, gtol=1e-10, x_scale="jac")
    return float(found.cost) + values.size * 0.5 * np.log(2 * np.pi * SD**2), np.exp(found.x)


# -------------------------------------------------------------------------------------------------------- PEtab files
def model() -> str:
    """The SBML document."""
    document = libsbml.SBMLDocument(3, 2)
    made = document.createModel()
    made.setId("signalling")
    cell = made.createCompartment()
    cell.setId("cell")
    cell.setSize(1.0)
    cell.setConstant(True)
    for name in (*TRUTH, "L"):
        one = made.createParameter()
        one.setId(name)
        one.setValue(1.0)
        one.setConstant(True)
    for name in PAIRS:
        for id, amount in ((name, 1.0), (f"{name}a", 0.0)):
            one = made.createSpecies()
            one.setId(id)
            one.setCompartment("cell")
            one.setInitialConcentration(amount)
            one.setHasOnlySubstanceUnits(False)
            one.setBoundaryCondition(False)
            one.setConstant(False)
        for label, sides, law in (
            ("on", (name, f"{name}a"), LAWS[name][0]),
            ("off", (f"{name}a", name), LAWS[name][1]),
        ):
            reaction = made.createReaction()
            reaction.setId(f"{name}_{label}")
            reaction.setReversible(False)
            for side, species in zip((reaction.createReactant(), reaction.createProduct()), sides, strict=True):
                side.setSpecies(species)
                side.setStoichiometry(1.0)
                side.setConstant(True)
            used = {node for node in ("Ra", "Ma", "Ea", "Xa") if node in law} - set(sides)
            for species in sorted(used):
                reaction.createModifier().setSpecies(species)
            reaction.createKineticLaw().setMath(libsbml.parseL3Formula(f"cell*({law})"))
    return str(libsbml.writeSBMLToString(document))


def written(folder: Path, values: Array, start: dict[str, float]) -> Path:
    """A problem of PEtab 1."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(model())

    def table(name: str, *rows: Sequence[object]) -> None:
        with (folder / f"{name}.tsv").open("w", newline="") as file:
            csv.writer(file, delimiter="\t", lineterminator="\n").writerows(rows)

    table("conditions", ("conditionId", "L"), *DOSES.items())
    observed = [f"{name}a" for name in PAIRS]
    table("observables", ("observableId", "observableFormula", "noiseFormula"), *((f"o_{n}", n, SD) for n in observed))
    table(
        "measurements", ("observableId", "simulationConditionId", "time", "measurement"),
        *((f"o_{n}", d, t, repr(float(values[i, j, k]))) for i, d in enumerate(DOSES) for j, t in enumerate(TIMES)
          for k, n in enumerate(observed)),
    )  # fmt: skip
    table(
        "parameters", ("parameterId", "parameterScale", "lowerBound", "upperBound", "nominalValue", "estimate"),
        *((name, "log10", LOWER, UPPER, repr(value), 1) for name, value in start.items()),
    )  # fmt: skip
    words = ("condition", "measurement", "observable")
    lines = ["format_version: 1", "parameter_file: parameters.tsv", "problems:", "- sbml_files: [model.xml]"]
    lines += [f"  {word}_files: [{word}s.tsv]" for word in words]
    (folder / "problem.yaml").write_text("\n".join(lines) + "\n")
    return folder / "problem.yaml"


# -------------------------------------------------------------------------------------------------------------- study
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("-o", dest="out", type=Path)
    given = parser.parse_args()
    random = np.random.default_rng(1)
    values = solved(list(TRUTH.values()))
    values = values + random.normal(0, SD, values.shape)
    start = {name: float(10 ** random.uniform(-1.5, 1.5)) for name in TRUTH}
    best, constants = independent(values)
    made = import_file(written(given.work / "petab", values, start), given.work / "imported")
    begun = time.process_time()
    run = gbspec.train(str(made.model), str(made.data), str(given.work / "run"), workers=1, **made.options)
    seconds = time.process_time() - begun
    found = run.evaluate(str(made.data))
    learned = {name: float(run.constants[name]) for name in TRUTH}
    text = page(best, constants, found.nllh, learned, start, seconds, Path(made.model).name)
    print(text)
    if given.out is not None:
        given.out.write_text(text, encoding="utf-8")


def page(
    best: float, constants: Array, nllh: float, learned: dict[str, float], start: dict[str, float], seconds: float,
    name: str,
) -> str:  # fmt: skip
    """The table."""
    lines = [
        "# A signalling model by PEtab",
        "",
        "A cascade of four proteins (8 states) with a feedback, 9 rate constants with bounds from 1e-3 to 1e3, three",
        "doses and 144 values with a noise of 0.02, written as PEtab files from a known truth, imported into one `.gb`",
        f"file (`{name}`) and one table, and fitted by default from starts within three decades:",
        "",
        "    python -m benchmarks.studies.signalling WORK -o docs/studies/signalling.md",
        "",
        "The independent optimum is that of scipy (LSODA at 1e-10, `least_squares` from the truth).",
        "",
        "| | negative log likelihood |",
        "|---|---:|",
        f"| independent optimum | {best:.6f} |",
        f"| fit of the import | {nllh:.6f} |",
        f"| difference | {nllh - best:.1e} |",
        "",
        f"The fit took {seconds:.0f} s of processor time.",
        "",
        "| constant | truth | start | independent optimum | fit |",
        "|---|---:|---:|---:|---:|",
        *(
            f"| {n} | {TRUTH[n]:g} | {start[n]:.3g} | {c:.5g} | {learned[n]:.5g} |"
            for n, c in zip(TRUTH, constants, strict=True)
        ),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
