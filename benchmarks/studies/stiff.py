"""Stiff equations: solutions against published references, and fits of their constants and of an unknown rate.

    python -m benchmarks.studies.stiff -o stiff
    python -m benchmarks.studies.stiff -o stiff --only robertson hires

`solution`: the largest relative error of the solver of the training (`ros34pw2` at the tolerance of `--rtol`) and of
`simulate` (CVODES) at the end of the span, against the references of the Test Set for IVP Solvers (Mazzia and Magherini
2008). Constants: fits with all defaults to noise-free values of all states from starts that are given, by 50 rows; the
largest relative error of a constant. `robertson_gb`: the error of the learned rate relative to `k1*y1` along the
trajectory. Writes OUT/stiff.json and prints the table of docs/studies/stiff.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

VAN_DER_POL = """model van_der_pol
time t from 0
state x in [-3, 3]
state y
learn a = 300 in [10, 1e5]
learn b = 3 in [0.01, 100]
x' = y
y' = a*(1 - x^2)*y - b*x
initial x = 2
initial y = 0
observe x
truth a = 1000
truth b = 1
"""
HIRES = """model hires
time t from 0
{states}
learn k1 = 1 in [0.1, 100]
learn k2 = 100 in [1, 1e4]
y1' = -k1*y1 + 0.43*y2 + 8.32*y3 + 0.0007
y2' = k1*y1 - 8.75*y2
y3' = -10.03*y3 + 0.43*y4 + 0.035*y5
y4' = 8.32*y2 + 1.71*y3 - 1.12*y4
y5' = -1.745*y5 + 0.43*y6 + 0.43*y7
y6' = -k2*y6*y8 + 0.69*y4 + 1.71*y5 - 0.43*y6 + 0.69*y7
y7' = k2*y6*y8 - 1.81*y7
y8' = -k2*y6*y8 + 1.81*y7
initial y1 = 1
{starts}
initial y8 = 0.0057
{observed}
truth k1 = 1.71
truth k2 = 280
""".format(
    states="\n".join(f"state y{i}" for i in range(1, 9)),
    starts="\n".join(f"initial y{i} = 0" for i in range(2, 8)),
    observed="\n".join(f"observe y{i}" for i in range(1, 9)),
)
OREGONATOR = """model oregonator
time t from 0
state y1
state y2
state y3
learn s = 50 in [1, 1000]
learn w = 1 in [0.01, 10]
const q = 8.375e-6
y1' = s*(y2 + y1*(1 - q*y1 - y2))
y2' = (y3 - (1 + y1)*y2)/s
y3' = w*(y1 - y3)
initial y1 = 1
initial y2 = 2
initial y3 = 3
observe y1 noise lognormal(0.01)
observe y2 noise lognormal(0.01)
observe y3 noise lognormal(0.01)
truth s = 77.27
truth w = 0.161
"""


@dataclass(frozen=True)
class Case:
    """A model (a text, or the name of a bundled one), the times of its rows, and the published end of its solution."""

    text: str
    times: Any
    reference: tuple[float, ...] = ()


CASES: dict[str, Case] = {
    "robertson": Case("robertson", np.logspace(-5, 5, 50)),
    "robertson_gb": Case("robertson_gb", np.logspace(-5, 5, 50)),
    "van der Pol": Case(VAN_DER_POL, np.linspace(40, 2000, 50), (1.706167732170469, -8.928097010248125e-4)),
    "HIRES": Case(
        HIRES,
        np.linspace(321.8122 / 50, 321.8122, 50),
        (
            0.7371312573325668e-3,
            0.1442485726316185e-3,
            0.5888729740967575e-4,
            0.1175651343283149e-2,
            0.2386356198831331e-2,
            0.6238968252742796e-2,
            0.2849998395185769e-2,
            0.2850001604814231e-2,
        ),
    ),
    "Oregonator": Case(
        OREGONATOR,
        np.linspace(360 / 50, 360, 50),
        (0.1000814870318523e1, 0.1228178521549917e4, 0.1320554942846706e3),
    ),
}


def model_of(case: Case, place: Path) -> Any:
    """The model of a case."""
    from gbspec.data import shipped_model
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model

    path = shipped_model(case.text) if "\n" not in case.text else None
    if path is None:
        path = place / "model.gb"
        path.write_text(case.text, encoding="utf-8")
    return load_model(str(path), Findings())


def exact(model: Any, times: Any) -> Any:
    """States [n_times, n_states] at the true constants and functions, by scipy's Radau at tolerances near rounding."""
    from gbspec.backends import Evaluator
    from gbspec.operations import models

    evaluator: Evaluator = models.reference(model).evaluator
    start = evaluator.initial(np.zeros(len(model.states)))
    none = np.zeros(0)

    def rates(t: float, x: Any) -> Any:
        return np.array(evaluator.rhs(t, x, none, none, evaluator.constants)).ravel()

    def slopes(t: float, x: Any) -> Any:
        return np.array(evaluator.jacobian(t, x, none, none, evaluator.constants))

    scale = np.where(start == 0, 1.0, np.abs(start))
    found = solve_ivp(
        rates, (0.0, times[-1]), start, "Radau", np.asarray(times), rtol=1e-12, atol=1e-16 * scale, jac=slopes
    )
    return found.y.T


def solutions(model: Any, case: Case, rtol: float) -> dict[str, float]:
    """Errors of solutions at the end of the span."""
    from gbspec.backends import load_module
    from gbspec.ir import STIFF
    from gbspec.operations import models

    evaluator = models.reference(model).evaluator
    start, times = evaluator.initial(np.zeros(len(model.states))), [0.0, float(case.times[-1])]
    wanted = np.array(case.reference) if case.reference else exact(model, case.times)[-1]
    module = load_module(models.reference(model).model, STIFF)({"constants": evaluator.constants})
    began = time.process_time()
    ours = module.simulate(start, times, tolerance=rtol).numpy()[-1]
    seconds = time.process_time() - began
    cvodes = evaluator.integrate(start, times)[-1]
    return {
        "solution": float(np.abs(ours / wanted - 1).max()),
        "cvodes": float(np.abs(cvodes / wanted - 1).max()),
        "solution_seconds": seconds,
    }


def fitted(model: Any, case: Case, place: Path, effort: Any = "normal") -> dict[str, Any]:
    """A fit with all defaults but the effort."""
    from gbspec.data import Trajectories, Trajectory
    from gbspec.operations import fitting
    from gbspec.training import TrainOptions

    states = exact(model, case.times)
    values = states[:, [channel.state for channel in model.channels]]
    row = Trajectory("0", 0.0, case.times, values, np.ones_like(values), np.full_like(values, np.nan), np.zeros(0))
    data = Trajectories((row,), tuple(channel.name for channel in model.channels))
    began = time.time(), time.process_time()
    run = fitting.fit(model, data, place / "run", TrainOptions(threads=1, workers=1, effort=effort))
    out: dict[str, Any] = {
        "fit_wall": time.time() - began[0],
        "fit_seconds": time.process_time() - began[1],
        "solver": run.fit.solver,
        "loss": run.fit.members[0].loss,
    }
    truth = {constant.name: float(constant.value) for constant in model.truth_constants}
    if run.fit.constants:
        off = {name: abs(run.fit.constants[name].value / true - 1) for name, true in truth.items()}
        out |= {"constants": max(off.values()), "errors": off}
    if model.unknowns:
        out["rate"] = rate_error(run, states)
    return out


def rate_error(run: Any, states: Any) -> float:
    """The largest error of Robertson's fast rate relative to that of the slow one, along the trajectory."""
    import torch

    learned = run.member().functions["back"](torch.from_numpy(states[:, 1:3])).detach().numpy()
    return float(np.abs((learned - 1e4 * states[:, 1] * states[:, 2]) / (0.04 * states[:, 0])).max())


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """The table of the documentation."""

    def cell(row: Mapping[str, Any], key: str, text: Callable[[Any], str] = "{:.1e}".format) -> str:
        return text(row[key]) if row.get(key) is not None else ""

    head = "| case | solution, ros34pw2 | solution, CVODES | constants | rate | solver chosen | CPU s of the fit |"
    lines = [head, "|---|---:|---:|---:|---:|---|---:|"]
    for name, row in results.items():
        cells = [cell(row, key) for key in ("solution", "cvodes", "constants", "rate")]
        chosen = cell(row, "solver", "`{}`".format)
        lines.append(f"| {name} | {' | '.join(cells)} | {chosen} | {cell(row, 'fit_seconds', '{:.1f}'.format)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("-o", "--out", type=Path, default=Path("stiff"))
    parser.add_argument("--only", nargs="*", default=list(CASES))
    parser.add_argument("--rtol", type=float, default=3e-9)
    parser.add_argument("--no-fit", action="store_true")
    parser.add_argument("--effort", default="normal")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "stiff.json"
    results: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else {}
    for name in given.only:
        case, place = CASES[name], given.out / name.replace(" ", "_")
        place.mkdir(exist_ok=True)
        model = model_of(case, place)
        row = {} if model.unknowns else solutions(model, case, given.rtol)
        if not given.no_fit:
            row |= fitted(model, case, place, given.effort)
        results[name] = row
        path.write_text(json.dumps(results, indent=1))
        print(name, row, flush=True)
    print(table({name: results[name] for name in CASES if name in results}))


if __name__ == "__main__":
    main()
