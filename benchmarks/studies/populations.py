"""Populations: published data against reference likelihoods, and simulated populations against their truth.

    python -m benchmarks.studies.populations published DATA
    python -m benchmarks.studies.populations simulated COUNT FIRST

The first takes theophylline.csv and phenobarbital.csv from the folder DATA, the second makes COUNT populations of each
model, from the seed FIRST on, and prints a line for each: processor time, -2 log likelihood, and for each median and
spread the relative error and whether the 90 % interval holds the truth. Each fit is `gbspec train` with its defaults.
Simulated populations have 100 subjects; random numbers are drawn here, solutions are closed forms, so that nothing of
the fit takes part in making the data.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.operations import tables
from gbspec.runs import Run
from gbspec.training import TrainOptions, train

ORAL = """model oral
time t : h from 0
state A : mg
state C : mg/L
condition dose : mg
learn ka : 1/h = 1.5 in [0.1, 20] per trajectory ~ lognormal
learn CL : L/h = 3 in [0.1, 50] per trajectory ~ lognormal
learn V : L = 30 in [1, 300] per trajectory ~ lognormal
A' = -ka*A
C' = ka*A/V - CL/V*C
initial A = dose
initial C = 0
observe conc = C : mg/L
"""
BOLUS = """model bolus
time t : h from 0
state A : mg
condition dose : mg
learn CL : L/h = 0.006 in [0.0005, 0.1] per trajectory ~ lognormal
learn V : L = 1.4 in [0.1, 10] per trajectory ~ lognormal
learn a : mg/L = 0.3 in [0.01, 10]
learn b = 0.1 in [0.005, 1]
correlate CL, V
A' = -CL/V*A
initial A = dose
observe conc = A/V : mg/L noise normal(sqrt(a^2 + (b*y)^2))
"""
PHENOBARBITAL = """model phenobarbital_population
time t : h from 0
state A : mg
learn CL : L/h = 0.006 in [0.0005, 0.1] per trajectory ~ lognormal
learn V : L = 1.4 in [0.1, 10] per trajectory ~ lognormal
dose A
A' = -CL/V*A
initial A = 0
observe conc = A/V : mg/L
"""
THEOPHYLLINE = ORAL.replace("dose", "dose_mg")

SUBJECTS = 100
TRUTHS = {
    "oral": {"ka": (1.5, 0.5), "CL": (2.8, 0.3), "V": (32.0, 0.2), "noise": 0.5},
    "bolus": {"CL": (0.006, 0.4), "V": (1.4, 0.3), "a": 0.3, "b": 0.1, "correlation": 0.4},
}


def oral(random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Doses [N], times [T] and concentrations [N, T] of one population."""
    truth, times = TRUTHS["oral"], np.array([0.25, 0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 24.0])
    ka, cl, v = (truth[k][0] * np.exp(truth[k][1] * random.standard_normal((SUBJECTS, 1))) for k in ("ka", "CL", "V"))
    dose, k = random.uniform(250, 400, (SUBJECTS, 1)), cl / v
    mean = dose * ka / (v * (ka - k)) * (np.exp(-k * times) - np.exp(-ka * times))
    return dose[:, 0], times, mean + truth["noise"] * random.standard_normal(mean.shape)


def bolus(random: np.random.Generator) -> tuple[Array, Array, Array]:
    """The same with correlated constants and a combined noise."""
    truth, times = TRUTHS["bolus"], np.array([2.0, 24.0, 72.0, 150.0])
    r = truth["correlation"]
    z = random.standard_normal((SUBJECTS, 2)) @ np.array([[1.0, r], [0.0, np.sqrt(1 - r * r)]])
    cl, v = (truth[k][0] * np.exp(truth[k][1] * z[:, i : i + 1]) for i, k in enumerate(("CL", "V")))
    dose = random.uniform(15, 30, (SUBJECTS, 1))
    mean = dose / v * np.exp(-cl / v * times)
    sd = np.sqrt(truth["a"] ** 2 + (truth["b"] * mean) ** 2)
    return dose[:, 0], times, mean + sd * random.standard_normal(mean.shape)


def fit(text: str, table: Path, folder: Path, **options: object) -> tuple[Run, float]:
    """A run with the defaults, and its seconds of processor time."""
    (folder / "model.gb").write_text(text)
    findings = Findings()
    model = load_model(folder / "model.gb", findings)
    findings.raise_if_failed()
    data = tables.read_data(table, model, findings)
    began = time.process_time()
    run = train(model, data, TrainOptions(**options), folder / "run")  # type: ignore[arg-type]  # options by name
    return run, time.process_time() - began


def published(data: Path) -> None:
    """The likelihoods and estimates of the two published tables, by Laplace's method and by quadrature."""
    for name, text in (("theophylline", THEOPHYLLINE), ("phenobarbital", PHENOBARBITAL)):
        for nodes in (1, 7):
            with tempfile.TemporaryDirectory() as folder:
                run, seconds = fit(text, data / f"{name}.csv", Path(folder), quadrature=nodes)
                found = run.fit.population
                assert found is not None
                effects = ", ".join(f"{k} {one.median:.5g}; {one.sd:.4g}" for k, one in found.effects.items())
                noise = run.fit.noise["conc"]
                row = (name, nodes, f"{found.minus2ll:.4f}", effects, f"{noise:.4g}", f"{seconds:.1f} s")
                print("| " + " | ".join(map(str, row)) + " |", flush=True)


def simulated(count: int, first: int) -> None:
    """Estimates of simulated populations: one line for each, with whether the 90 % intervals hold the truth."""
    for name, text, made in (("oral", ORAL, oral), ("bolus", BOLUS, bolus)):
        for seed in range(first, first + count):
            dose, times, values = made(np.random.default_rng([seed, 11]))
            with tempfile.TemporaryDirectory() as where:
                folder = Path(where)
                rows = [
                    f"{i + 1},{t},{y!r},{d!r}"
                    for i, (d, row) in enumerate(zip(dose.tolist(), values.tolist(), strict=True))
                    for t, y in zip(times, row, strict=True)
                ]
                (folder / "data.csv").write_text("\n".join(["trajectory,t,conc,dose", *rows]) + "\n")
                run, seconds = fit(text, folder / "data.csv", folder)
            found = run.fit.population
            assert found is not None
            cells = []
            for effect, one in found.effects.items():
                median, sd = TRUTHS[name][effect]
                for value, truth, interval in ((one.median, median, one.interval), (one.sd, sd, one.sd_interval)):
                    inside = interval is not None and interval[0] <= truth <= interval[1]
                    cells.append(f"{effect}:{value / truth - 1:.5f}:{int(inside)}")
            print(f"{name} {seed} {seconds:.1f} {found.minus2ll:.4f} " + " ".join(cells), flush=True)


def main() -> None:
    """The part that was asked for."""
    if sys.argv[1] == "published":
        published(Path(sys.argv[2]))
    else:
        simulated(int(sys.argv[2]), int(sys.argv[3]))


if __name__ == "__main__":
    main()
