"""Stiff populations: a drug that binds its target fast, fitted by `--solver auto`, and what explicit steps would cost.

    python -m benchmarks.studies.stiff_populations -o stiff_populations

Tables of `SUBJECTS` subjects, four doses, 11 concentrations each with 10 % lognormal noise, are made by scipy's Radau
method from a known truth; each is fitted with all defaults, the first one also with the solver named. Prints the
estimates with their distances from the truth, and processor seconds of a likelihood with its gradient by either method
at the truth. Writes OUT/results.json.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

MODEL = """model tmdd "Target-mediated disposition: a drug that binds its target fast"
time t from 0
condition dose in [1, 100] = 10 "dose by volume, nmol/L"
state C in [0, 200] "free drug"
state R in [0, 50] "free target"
state P in [0, 50] "complex"
const kon = 100
const koff = 10
learn ke = 0.2 in [0.01, 3] per trajectory ~ lognormal
learn R0 = 2 in [0.1, 30] per trajectory ~ lognormal
learn kd = 1 in [0.05, 10]
learn ki = 0.3 in [0.01, 5]
learn e = 0.2 in [0.01, 1]
C' = -ke*C - kon*C*R + koff*P
R' = kd*(R0 - R) - kon*C*R + koff*P
P' = kon*C*R - (koff + ki)*P
initial C = dose
initial R = R0
initial P = 0
observe C noise lognormal(e)
"""
TRUTH = {"ke": 0.3, "R0": 5.0, "kd": 0.5, "ki": 0.15, "e": 0.1}
SPREAD = 0.3
SUBJECTS, DOSES = 40, (10.0, 30.0, 60.0, 90.0)
TIMES = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 6.0, 9.0, 12.0, 18.0, 24.0)
SHORT = 2.5e-4
"""Steps at which `rk4` is stable."""


def simulated(path: Path, seed: int) -> None:
    """A table of measured concentrations."""
    random = np.random.default_rng(seed)
    lines = ["trajectory,t,dose,C"]
    for i in range(SUBJECTS):
        ke, start = (TRUTH[name] * np.exp(SPREAD * random.standard_normal()) for name in ("ke", "R0"))
        dose, kd, ki = DOSES[i % len(DOSES)], TRUTH["kd"], TRUTH["ki"]

        def rates(t: float, x: Any, ke: float = ke, start: float = start, kd: float = kd, ki: float = ki) -> Any:
            bound = 100 * x[0] * x[1] - 10 * x[2]
            return [-ke * x[0] - bound, kd * (start - x[1]) - bound, bound - ki * x[2]]

        found = solve_ivp(rates, (0, TIMES[-1]), [dose, start, 0], "Radau", TIMES, rtol=1e-10, atol=1e-13).y[0]
        found *= np.exp(np.sqrt(np.log1p(TRUTH["e"] ** 2)) * random.standard_normal(len(found)))
        lines += [f"{i},{t},{dose},{x}" for t, x in zip(TIMES, found, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def fitted(model: Any, data: Any, solver: str, place: Path) -> dict[str, Any]:
    """A fit with this solver, and all other options the defaults."""
    from gbspec.operations import fitting
    from gbspec.training import TrainOptions

    began = time.process_time()
    run = fitting.fit(model, data, place, TrainOptions(solver=solver, threads=1, workers=1))
    population = run.fit.population
    return {
        "seconds": time.process_time() - began,
        "solver": run.fit.solver,
        "reason": run.fit.solver_reason,
        "minus2ll": None if population is None else population.minus2ll,
        "constants": {name: (run.fit.constants[name].value, run.fit.constants[name].sd) for name in TRUTH},
    }


def evaluated(model: Any, data: Any, solver: str, **options: Any) -> dict[str, Any]:
    """Minus twice the log joint density `g` at the truth and z = 0, and processor seconds of it and of the gradient of
    the marginal likelihood (the second time: the first one compiles)."""
    import torch

    from gbspec.backends import load_module
    from gbspec.ir import METHODS
    from gbspec.training import TrainOptions
    from gbspec.training.population import Layout, Marginal, Predictions
    from gbspec.training.recipe import build_context

    context = build_context(model, load_module(model, METHODS[solver]), data, TrainOptions(**options), 0)
    parameters = context.parameters({})
    layout = Layout(parameters)
    names = tuple(k.name for k in layout.distributed)
    marginal = Marginal(layout, Predictions(context.problem(0.0), parameters, context.choice, names))
    known = {"median_ke": TRUTH["ke"], "median_R0": TRUTH["R0"], "sd_ke": SPREAD, "sd_R0": SPREAD, **TRUTH}
    u = layout.bijections.from_natural(np.array([known[name] for name in layout.names]))
    likelihood, none = marginal.likelihood, np.zeros(0)
    z = torch.zeros((likelihood.count, 2), dtype=torch.float64)
    natural = layout.natural(marginal.rows(u))
    times = []
    for moved in (0.0, 0.001):  # the first time compiles
        began = time.process_time()
        g = float(likelihood.joint(likelihood.at(natural, z + moved, none), z).sum())
        middle = time.process_time()
        marginal.slopes(u, none, z.numpy() + moved)
        times = [middle - began, time.process_time() - middle]
    path = marginal.predictions.individuals.path(likelihood.individual(natural, z)[0].numpy(), none)
    return {"g": g, "density": times[0], "gradient": times[1], "steps": int(path.packed.steps.sum())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("-o", "--out", type=Path, default=Path("stiff_populations"))
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args()
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.operations import tables

    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "tmdd.gb").write_text(MODEL, encoding="utf-8")
    model, results = load_model(str(given.out / "tmdd.gb"), Findings()), {}
    for seed in range(given.seeds):
        table = given.out / f"{seed}.csv"
        simulated(table, seed)
        data = tables.read_data(table, model, Findings())
        if not seed:
            results["ros34pw2 at 1e-6"] = evaluated(model, data, "ros34pw2", tolerance=1e-6)
            results["rk4"] = evaluated(model, data, "rk4", max_step=SHORT)
        for solver in ("auto", "ros34pw2") if not seed else ("auto",):
            results[f"{solver}, table {seed}"] = fitted(model, data, solver, given.out / f"{solver}_{seed}")
        (given.out / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    for name, row in results.items():
        print(name, {key: value for key, value in row.items() if key != "constants"})
        for constant, (value, sd) in row.get("constants", {}).items():
            print(f"    {constant} {value:.5g} (truth {TRUTH[constant]:g}, {(value - TRUTH[constant]) / sd:+.2f} sd)")


if __name__ == "__main__":
    main()
