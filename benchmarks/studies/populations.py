"""Populations: published data against reference likelihoods, and simulated populations against their truth.

    python -m benchmarks.studies.populations published DATA
    python -m benchmarks.studies.populations networks DATA
    python -m benchmarks.studies.populations simulated benchmarks/studies/populations_rows.txt COUNT
    python -m benchmarks.studies.populations many SUBJECTS
    python -m benchmarks.studies.populations bands COUNT

The first two take theophylline.csv and phenobarbital.csv from the folder DATA: known forms, and one form as a network
of two arguments, of which one is an effect. The third makes COUNT populations of each model, writes a row for each into
the file (fits whose rows it has are not repeated), and prints bias and coverage. The next fits one population of
SUBJECTS with two workers, and prints times and memory. The last fits COUNT populations of 24 subjects with a network as
elimination, and prints how many points of its band contain the true function, and how many values of 20 new subjects
lie inside their 90 % intervals, predicted from the first third of their rows. Each fit is `gbspec train` with its
defaults otherwise. The other simulated populations have 100 subjects; random numbers are drawn here, and solutions are
closed forms, so that nothing of the fit takes part in making the data.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.special import lambertw

from gbspec.analysis import forecast, function_bands
from gbspec.arrays import Array
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.operations import tables
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.population import results

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
ABSORPTION = """model theophylline_network
time t : h from 0
state A : mg
state C : mg/L
condition dose_mg : mg
learn CL : L/h = 3 in [0.1, 50] per trajectory ~ lognormal
learn V : L = 30 in [1, 300] per trajectory ~ lognormal
effect e per trajectory
unknown absorption(A in [0, 400], e in [-3, 3]) : mg/h
    >= 0, zero at A = 0
    = 1.5*A*nn
    by mlp(8, 8)
A' = -absorption(A, e)
C' = absorption(A, e)/V - CL/V*C
initial A = dose_mg
initial C = 0
observe conc = C : mg/L
"""
ELIMINATION = """model phenobarbital_network
time t : h from 0
state A : mg
effect e per trajectory
learn V : L = 1.4 in [0.1, 10] per trajectory ~ lognormal
dose A
let c = A/V
unknown elimination(c in [0, 60], e in [-3, 3]) : mg/h
    >= 0, zero at c = 0
    = 0.006*c*nn
    by mlp(8, 8)
A' = -elimination(c, e)
initial A = 0
observe conc = A/V : mg/L
"""
SATURATING = """model saturating
time t from 0
state conc in [0, 6]
condition dose
effect e per trajectory
learn s = 0.3 in [0.01, 2]
unknown r(conc in [0, 6]) >= 0, zero at conc = 0, increasing in conc by mlp(4)
conc' = -r*exp(s*e)
initial conc = dose
observe conc
"""
"""Elimination by an enzyme whose amount differs between subjects: truly 2 c/(2 + c), s = 0.3; noise 0.05."""
THEOPHYLLINE = ORAL.replace("dose", "dose_mg")

SUBJECTS = 100
TRUTHS = {
    "oral": {"ka": (1.5, 0.5), "CL": (2.8, 0.3), "V": (32.0, 0.2), "noise": 0.5},
    "bolus": {"CL": (0.006, 0.4), "V": (1.4, 0.3), "a": 0.3, "b": 0.1, "correlation": 0.4},
}


def oral(random: np.random.Generator, subjects: int = SUBJECTS) -> tuple[Array, Array, Array]:
    """Doses [N], times [T] and concentrations [N, T] of one population."""
    truth, times = TRUTHS["oral"], np.array([0.25, 0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 24.0])
    ka, cl, v = (truth[k][0] * np.exp(truth[k][1] * random.standard_normal((subjects, 1))) for k in ("ka", "CL", "V"))
    dose, k = random.uniform(250, 400, (subjects, 1)), cl / v
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


def saturating(random: np.random.Generator, subjects: int) -> tuple[Array, Array, Array]:
    """The same with a saturating elimination: c + 2 log c falls by 2 f t, solved by Lambert's function."""
    times = np.linspace(0.5, 8, 8)
    amount = np.exp(0.3 * random.standard_normal((subjects, 1)))
    mean = 2 * lambertw(2.5 * np.exp((5 - 2 * amount * times) / 2)).real
    return np.full(subjects, 5.0), times, mean + 0.05 * random.standard_normal(mean.shape)


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
    """The likelihoods and estimates of the two published tables, by default, by Laplace's method and by quadrature."""
    for name, text in (("theophylline", THEOPHYLLINE), ("phenobarbital", PHENOBARBITAL)):
        for nodes in (None, 1, 7):
            with tempfile.TemporaryDirectory() as folder:
                run, seconds = fit(text, data / f"{name}.csv", Path(folder), quadrature=nodes)
                found = run.fit.population
                assert found is not None
                effects = ", ".join(f"{k} {one.median:.5g}; {one.sd:.4g}" for k, one in found.effects.items())
                noise = run.fit.noise["conc"]
                way = found.nodes if nodes else f"default: {found.nodes}"
                row = (name, way, f"{found.minus2ll:.4f}", effects, f"{noise:.4g}", f"{seconds:.1f} s")
                print("| " + " | ".join(map(str, row)) + " |", flush=True)


def networks(data: Path) -> None:
    """The likelihoods of the two published tables with a network in place of a known form."""
    for name, text in (("theophylline", ABSORPTION), ("phenobarbital", ELIMINATION)):
        with tempfile.TemporaryDirectory() as folder:
            run, seconds = fit(text, data / f"{name}.csv", Path(folder))
            found = run.fit.population
            assert found is not None
            row = (name, f"{found.minus2ll:.3f}", f"{found.parameters:.1f}", f"{run.fit.noise['conc']:.4g}")
            print("| " + " | ".join([*row, f"{seconds:.1f} s"]) + " |", flush=True)


def written(made: tuple[Array, Array, Array], path: Path) -> Path:
    """A table of doses, times and concentrations."""
    dose, times, values = made
    rows = [
        f"{i + 1},{t},{y!r},{d!r}"
        for i, (d, row) in enumerate(zip(dose.tolist(), values.tolist(), strict=True))
        for t, y in zip(times, row, strict=True)
    ]
    path.write_text("\n".join(["trajectory,t,conc,dose", *rows]) + "\n")
    return path


def many(subjects: int) -> None:
    """One large population: estimates, processor time (of this process), time by the clock, and largest memory."""
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        table = written(oral(np.random.default_rng([1, 11]), subjects), folder / "data.csv")
        began = time.perf_counter()
        run, seconds = fit(ORAL, table, folder, workers=2)
        wall = time.perf_counter() - began
    found = run.fit.population
    assert found is not None
    effects = ", ".join(f"{k} {one.median:.4g}; {one.sd:.4g}" for k, one in found.effects.items())
    memory = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1e6
    cells = (subjects, f"{found.minus2ll:.1f}", effects, f"{run.fit.noise['conc']:.4g}")
    print("| " + " | ".join(map(str, cells)) + f" | {seconds:.0f} s | {wall:.0f} s | {memory:.2f} GB |")


def bands(count: int) -> None:
    """Coverage of the band of a learned function, of the spread's interval, and of predictions of new subjects."""
    points = np.linspace(0.2, 4.8, 24)
    truth = 2 * points / (2 + points)
    rows = []
    for seed in range(count):
        random = np.random.default_rng([seed, 11])
        with tempfile.TemporaryDirectory() as where:
            folder = Path(where)
            run, _ = fit(SATURATING, written(saturating(random, 24), folder / "data.csv"), folder, seed=seed)
            new = tables.read_data(written(saturating(random, 20), folder / "new.csv"), run.model, Findings())
            _, low, high = function_bands(run, "r", points[:, None])
            spread = run.fit.constants["s"].interval
            inside = spread is not None and spread[0] <= 0.3 <= spread[1]
            covered = forecast(run, new).errors()["conc"].covered
        rows.append((float(np.mean((low <= truth) & (truth <= high))), float(inside), covered))
    cells = [
        f"{100 * each.mean():.0f} % ({100 * each.min():.0f} to {100 * each.max():.0f})" for each in np.array(rows).T
    ]
    print("| " + " | ".join([str(count), *cells]) + " |")


def one_set(name: str, seed: int) -> str:
    """The row of one simulated population: seconds, -2 log likelihood, and for each median and spread the estimate over
    the truth, and whether the 90 % interval holds the truth."""
    text, made = {"oral": (ORAL, oral), "bolus": (BOLUS, bolus)}[name]
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        run, seconds = fit(text, written(made(np.random.default_rng([seed, 11])), folder / "data.csv"), folder)
    found = run.fit.population
    assert found is not None
    cells = [f"{seconds:.1f}", f"{found.minus2ll:.4f}"]
    for effect, one in found.effects.items():
        median, sd = TRUTHS[name][effect]
        for value, truth, interval in ((one.median, median, one.interval), (one.sd, sd, one.sd_interval)):
            inside = interval is not None and interval[0] <= truth <= interval[1]
            cells.append(f"{effect}:{value / truth:.6f}:{int(inside)}")
    return " ".join([name, str(seed), *cells])


def simulated(rows: Path, count: int) -> None:
    """Fits `count` populations of each model, those left out whose row the file `rows` has, and prints the table."""
    results.REPLICATES = 20  # data sets of the predictive check, which is not part of the study
    known = {tuple(line.split()[:2]) for line in rows.read_text().splitlines()} if rows.is_file() else set()
    for seed in range(1, count + 1):
        for name in TRUTHS:
            if (name, str(seed)) not in known:
                line = one_set(name, seed)
                with rows.open("a") as file:
                    file.write(line + "\n")
    print(table(rows.read_text().splitlines()))


def of_sample(name: str, seed: int) -> dict[str, tuple[float, float]]:
    """The median and the spread of each constant in one population over the true ones."""
    random = np.random.default_rng([seed, 11])
    if name == "oral":
        deviations = np.concatenate([random.standard_normal((SUBJECTS, 1)) for _ in range(3)], 1)
        names = ["ka", "CL", "V"]
    else:
        r = TRUTHS["bolus"]["correlation"]
        deviations = random.standard_normal((SUBJECTS, 2)) @ np.array([[1.0, r], [0.0, np.sqrt(1 - r * r)]])
        names = ["CL", "V"]
    spreads = [TRUTHS[name][k][1] for k in names]
    return {
        k: (float(np.exp(s * z.mean())), float(z.std(ddof=1)))
        for k, s, z in zip(names, spreads, deviations.T, strict=True)
    }


def table(lines: Sequence[str]) -> str:
    """Bias and coverage of each model's medians and spreads; the bias also against what the drawn subjects have, whose
    own deviation from the truth is no error of the method."""
    found: dict[tuple[str, str], list[tuple[float, float, bool]]] = {}
    for line in lines:
        name, seed, _, _, *cells = line.split()
        sample = of_sample(name, int(seed))
        for place, cell in enumerate(cells):
            effect, ratio, inside = cell.split(":")
            what, drawn = "spread" if place % 2 else "median", sample[effect][place % 2]
            row = float(ratio), float(ratio) / drawn, inside == "1"
            found.setdefault((name, f"{effect} {what}"), []).append(row)
    out = [
        "| model | populations | parameter | error | error against the drawn subjects | intervals that hold the truth |"
    ]
    out.append("|---|---:|---|---:|---:|---:|")
    for (name, parameter), each in found.items():
        cells = [_mean(np.array([row[i] for row in each])) for i in (0, 1)]
        inside = sum(row[2] for row in each)
        out.append(f"| {name} | {len(each)} | {parameter} | {cells[0]} | {cells[1]} | {inside} of {len(each)} |")
    return "\n".join(out)


def _mean(ratios: Array) -> str:
    """The mean error in percent, with its standard error."""
    error = 100 * ratios.std(ddof=1) / np.sqrt(len(ratios)) if len(ratios) > 1 else float("nan")
    return f"{100 * (ratios.mean() - 1):.1f} ± {error:.1f} %"


def main() -> None:
    """The part that was asked for."""
    if sys.argv[1] == "published":
        published(Path(sys.argv[2]))
    elif sys.argv[1] == "networks":
        networks(Path(sys.argv[2]))
    elif sys.argv[1] == "bands":
        bands(int(sys.argv[2]))
    elif sys.argv[1] == "many":
        many(int(sys.argv[2]))
    else:
        simulated(Path(sys.argv[2]), int(sys.argv[3]))


if __name__ == "__main__":
    main()
