"""Exports of all bundled models and of fitted runs: errors against the generated module, sizes, and times.

    python -m benchmarks.studies.export RUNS -o docs/studies/export.md

Bundled models are exported with random weights; `urp_gb2`, `fed_batch` and `friction_oscillator` also as fits of
simulated tables (`--effort low`, seed 1; a run that exists in RUNS is reused).
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import gbspec
from benchmarks import workload
from gbspec.backends import Evaluator, NotCoveredError, load_module
from gbspec.backends.c import c_code
from gbspec.data import DoseEvents, Signal, shipped_models
from gbspec.exports import Exported, ExportOptions
from gbspec.exports.c import Library
from gbspec.exports.c import make as make_c
from gbspec.exports.compiling import shared_library
from gbspec.exports.example import plain
from gbspec.exports.fmi import make as make_fmu
from gbspec.exports.onnx import make as make_onnx
from gbspec.exports.writing import archived
from gbspec.training.engines.native import NativeEngine, kernel_of

RUNS = {
    "urp_gb2": {"trajectories": 60, "sampling": "gamma", **workload.REGION},
    "fed_batch": {"trajectories": 20},
    "friction_oscillator": {"trajectories": 20},
}
"""Models that are fitted, with the options of their simulated tables."""
SPAN, INTERVAL = 2.0, 0.1
STEP, STIFF = 0.01, {"robertson_gb": 0.001}
"""The largest step of bundled models; the explicit method of a unit blows up at it where they are stiff."""
PRECISIONS = ("float64", "float32")
HEAD = """\
# Exports

`python -m benchmarks.studies.export RUNS -o docs/studies/export.md`. Errors are the largest ones at random points,
relative to the sizes of the terms: of a derivative the sum of its absolute terms, of a value its own size and those of
its arguments' contributions. "ME": fmpy with CVODE (relative tolerance 1e-11) over {span:g} time units against the
generated module by CVODES at 1e-10, relative to the largest state; "CS": steps of the unit against the same steps of
the module; inputs at three quarters of their ranges. Bundled models have random weights; "(run)" is a fit.
"""


def subjects(folder: Path) -> list[tuple[str, Exported]]:
    """What is exported, with its name in the tables."""
    found = []
    for name, path in sorted(shipped_models().items()):
        model = gbspec.load(path).model
        found.append((name, Exported(model, load_module(model).random(1), name, step=STIFF.get(name, STEP))))
    for name, options in RUNS.items():
        model = gbspec.load(name)
        if (folder / name / "fit.json").is_file():
            run = gbspec.open_run(folder / name).run
        else:
            data = model.simulate(dt=0.5, seed=1, noise=0.01, **options)
            run = model.train(data, folder / name, effort="low", seed=1).run
        found.append((f"{name} (run)", Exported(run.model, run.member(run.best), name, step=run.step(run.best))))
    return found


def pushed(range: Any, value: float) -> float:
    """A value of an input that is not in the middle of its range, where a system may be at rest."""
    return float(value) if range is None or not range.bounded else float(0.25 * range.low + 0.75 * range.high)


def worst(quantities: Any, words: str) -> float:
    """The largest error of the quantities whose names have these words."""
    return max((q.error for q in quantities if words in q.name), default=0.0)


# ------------------------------------------------------------------------------------------------------------- FMUs
def units(exported: Exported, folder: Path) -> list[str]:
    """The cells of a row for both versions."""
    import fmpy
    from fmpy.validation import validate_fmu

    cells = []
    for version in ("2", "3"):
        made = make_fmu(version, exported, ExportOptions())
        path = folder / f"unit{version}.fmu"
        path.write_bytes(archived(made.files))
        problems = len(validate_fmu(str(path)))
        evaluator, model = Evaluator(exported.instance), exported.model
        names = [state.name for state in model.states]
        options = {"start_time": exported.start, "stop_time": exported.start + SPAN, "output_interval": INTERVAL}
        errors = []
        held = [pushed(item.range, value) for item, value in zip(model.inputs, exported.inputs, strict=True)]
        starts = {item.name: value for item, value in zip(model.inputs, held, strict=True)}
        for kind in ("ModelExchange", "CoSimulation"):
            found = fmpy.simulate_fmu(
                str(path), fmi_type=kind, output=names, solver="CVode", relative_tolerance=1e-11, start_values=starts,
                **options,
            )  # fmt: skip
            times, keep = np.unique(found["time"], return_index=True)
            even = np.abs(times / INTERVAL - np.round(times / INTERVAL)) < 1e-6  # not those of events, before and after
            times, keep = times[even], keep[even]
            x0 = evaluator.initial(exported.states, exported.conditions)
            inputs = tuple(Signal(np.array([exported.start]), np.array([value])) for value in held)
            doses = tuple(DoseEvents(np.zeros(0), np.zeros(0)) for _ in model.doses)
            if kind == "ModelExchange":
                known = evaluator.integrate(x0, times, exported.conditions, inputs, exported.start, doses=doses)
            else:
                known = evaluator.integrate_fixed(
                    x0, times, exported.conditions, inputs, exported.start,
                    max_step=exported.step or INTERVAL, doses=doses,
                )  # fmt: skip
            states = np.stack([found[name] for name in names], axis=1)[keep]
            errors.append(float(np.abs(states - known).max() / np.abs(known).max()))
        values = worst(made.checked, "variables of the unit"), worst(made.checked, "directional")
        cells += [str(problems), *(f"{value:.0e}" for value in (*values, errors[1], errors[0]))]
        cells.append(f"{path.stat().st_size / 1000:.0f}")
    return cells


def libraries(exported: Exported) -> list[str]:
    """The cells of C."""
    checked = make_c(exported, plain(exported), ExportOptions()).checked
    source = len(Library(exported).source().encode()) / 1000
    return [f"{max(q.error for q in checked):.0e}", f"{source:.0f}"]


def graphs(exported: Exported, precision: Any) -> list[str]:
    """The cell of ONNX."""
    made = make_onnx(exported, ExportOptions(precision=precision))
    return [f"{max(q.error for q in made.checked):.0e}"]


def refused_or(cells: Callable[[], list[str]], count: int) -> list[str]:
    """Cells; the reason in the first of them where a form does not cover a model."""
    try:
        return cells()
    except NotCoveredError as problem:
        return [f"refused: {problem}", *[""] * (count - 1)]


# ------------------------------------------------------------------------------------------------------------- times
def timed(work: Callable[[], object], seconds: float = 0.5, rounds: int = 5) -> float:
    """The processor time of a call: the shortest mean over several rounds."""
    work()
    best = np.inf
    for _ in range(rounds):
        count, begin = 0, time.process_time()
        while time.process_time() - begin < seconds / rounds:
            work()
            count += 1
        best = min(best, (time.process_time() - begin) / count)
    return float(best)


def batches(exported: Exported, precision: Any, count: int = 1000) -> tuple[float, float]:
    """Seconds of the right-hand side at 1,000 states: onnxruntime, torch."""
    import onnxruntime
    import torch

    data = make_onnx(exported, ExportOptions(verify=False, precision=precision, part="rhs")).files["rhs.onnx"]
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    random, dtype = np.random.default_rng(0), np.dtype(precision)
    model = exported.model
    x = (exported.states * random.uniform(0.8, 1.2, (count, len(model.states)))).astype(dtype)
    condition, inputs = (np.tile(values, (count, 1)).astype(dtype) for values in (exported.conditions, exported.inputs))
    given = {"t": np.zeros(count, dtype), "x": x, "condition": condition, "inputs": inputs}
    names = {one.name for one in session.get_inputs()}
    fed = {name: value for name, value in given.items() if name in names}
    torch.set_num_threads(1)
    kind = getattr(torch, precision)
    weights = {name: torch.as_tensor(value, dtype=kind) for name, value in exported.instance.weights.items()}
    networks, math = exported.instance.torch_networks(weights), exported.instance.arithmetic("torch")
    tensors = [torch.from_numpy(given[name]) for name in ("t", "x", "condition", "inputs")]
    own = weights["constants"].unbind()

    def by_torch() -> None:
        with torch.no_grad():
            exported.instance.equations.rhs(math, *tensors, own, networks)

    return timed(lambda: session.run(None, fed)), timed(by_torch)


def steps(folder: Path) -> list[tuple[str, float]]:
    """Microseconds of one RK4 step of `urp_gb2`, 64x64: the library, CasADi's C, the training kernel."""
    model = gbspec.load("urp_gb2").model
    exported = Exported(model, load_module(model).random(1), "urp_gb2")
    library, found = Library(exported), []
    name = library.prefix
    sources = {f"{name}.h": library.header(), f"{name}.c": library.source()}
    loop = f'#include "{name}.h"\n__attribute__((visibility("default"))) void many(long n, double *x) {{\n'
    loop += f"    {name}_parameters p; long i;\n    {name}_defaults(&p);\n    p.Da = 0.3;\n"
    loop += f"    for (i = 0; i < n; i++) {name}_step(&p, 0.0, 1e-6, 0, x);\n}}\n"
    fast = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
    for flags, said in ((("-O2",), "-O2"), (fast, " ".join(fast))):
        # glibc has a function `step` of its own, which must not take the place of CasADi's
        chosen = ("-std=gnu99", "-fPIC", "-shared", "-Wl,-Bsymbolic", *flags)
        files = {**sources, "loop.c": loop, "casadi.c": c_code(exported.instance) + CASADI_LOOP}
        for number, (names, code) in enumerate(
            (([f"{name}.c", "loop.c"], "exported library"), (["casadi.c"], "`compile --emit c` (CasADi's C)"))
        ):
            built = shared_library(folder, files, folder / f"{number}_{len(found)}.so", names, chosen)
            many, x = ctypes.CDLL(str(built)).many, np.array([0.5, 1.5])
            each = timed(partial(many, ctypes.c_long(1000), x.ctypes.data_as(ctypes.c_void_p))) / 1000
            found.append((f"{code}, `{said}`", 1e6 * each))
    found.append(("training kernel, forward pass of 200 trajectories, a trajectory's step", 1e6 * kernel_step()))
    return found


CASADI_LOOP = """
#include <stdlib.h>
__attribute__((visibility("default"))) void many(long n, double *x) {
    long long arguments, results, integers, numbers;
    step_work(&arguments, &results, &integers, &numbers);
    const double **arg = calloc((size_t)arguments + 1, sizeof(double *));
    double **res = calloc((size_t)results + 1, sizeof(double *));
    long long *iw = calloc((size_t)integers + 1, sizeof(long long));
    double *w = calloc((size_t)numbers + 1, sizeof(double));
    double t = 0, h = 1e-6, condition = 0.3, after[2];
    for (long i = 0; i < n; i++) {
        arg[0] = &t; arg[1] = x; arg[2] = &h; arg[3] = &condition;
        res[0] = after;
        step(arg, res, iw, w, 0);
        x[0] = after[0]; x[1] = after[1];
    }
    free(arg); free(res); free(iw); free(w);
}
"""


def kernel_step() -> float:
    """Seconds of a sub-step of one trajectory in the forward pass of the training kernel, one thread."""
    import torch

    work = workload.make()
    torch.set_num_threads(1)
    kernel = kernel_of(work.problem.model, type(work.problem.module), "float64")
    engine = NativeEngine(work.problem, work.parameters, kernel)
    path = engine.plan(work.theta)
    return timed(lambda: engine.moments(work.theta, path), seconds=2.0) / work.substeps


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    given.runs.mkdir(parents=True, exist_ok=True)
    lines = [HEAD.format(span=SPAN), "## Functional mock-up units", ""]
    columns = ["problems", "values", "derivatives", "CS", "ME", "kB"]
    lines += ["| model | " + " | ".join(f"{word}, FMI {v}.0" for v in (2, 3) for word in columns) + " |"]
    lines += ["|---|" + "---:|" * (2 * len(columns))]
    second: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, exported in subjects(given.runs):
            cells = refused_or(lambda exported=exported: units(exported, Path(folder)), 2 * len(columns))
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
            cells = refused_or(lambda exported=exported: libraries(exported), 2)
            for precision in PRECISIONS:
                cells += refused_or(lambda e=exported, p=precision: graphs(e, p), 1)
            second.append(f"| {name} | " + " | ".join(cells) + " |")
            print(lines[-1], second[-1], sep="\n", flush=True)
        lines += ["", "## C and ONNX", "", "The largest error of all functions that the command compares.", ""]
        lines += [
            "| model | C | source, kB | ONNX, float64 | ONNX, float32 |",
            "|---|---:|---:|---:|---:|",
            *second,
            "",
        ]
        lines += [
            "## Times",
            "",
            "Processor time of one thread, other work sharing the machine. The right-hand side at 1,000 states:",
            "",
        ]
        lines += [
            "| model | onnxruntime, float64 | torch | onnxruntime, float32 | torch |",
            "|---|---:|---:|---:|---:|",
        ]
        for name in ("urp_gb2", "fed_batch", "friction_oscillator"):
            model = gbspec.load(name).model
            exported = Exported(model, load_module(model).random(1), name)
            both = [f"{1e3 * each:.2f} ms" for p in ("float64", "float32") for each in batches(exported, p)]
            lines.append(f"| {name} | " + " | ".join(both) + " |")
        lines += ["", "One RK4 step of `urp_gb2` (3-64-64-1):", "", "| code | µs |", "|---|---:|"]
        lines += [f"| {said} | {value:.1f} |" for said, value in steps(Path(folder))]
    given.output.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
