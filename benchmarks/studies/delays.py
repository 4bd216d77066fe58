"""Models with delays: the order of their solutions, and constants found from data without noise.

    python -m benchmarks.studies.delays -o delays.md

The order: Mackey-Glass from a constant history, whose jump of the rate at the start shows again after each delay, with
steps that begin there and with steps that do not. The fits: 100 values without noise, the delay unknown in [5, 40].
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from gbspec.api import Specification
from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import Trajectories, Trajectory
from gbspec.ir import Model
from gbspec.training.engines import Choice, Engine, TorchEngine, half_squares, linearise
from gbspec.training.engines.native import Kernel, NativeEngine, kernel_of
from gbspec.training.problem import Parameters, Problem, default_max_step, pack, scaling_of, teacher_forcing

TEXT = """model mackey_glass
time t from 0
state P in [0, 2]
learn tau in [5, 40]
learn beta in [0.05, 1]
learn gamma in [0.01, 0.5]
P' = beta*delay(P, tau)/(1 + delay(P, tau)^10) - gamma*P
initial P = 0.5
observe P
truth tau = {tau}
truth beta = 0.2
truth gamma = 0.1
"""
STEPS = (4.0, 2.0, 1.0, 0.5)
TIMES = np.linspace(0.0, 80.0, 9)


def orders(tau: float = 17.3) -> str:
    """The largest errors of solutions at several steps, with and without steps that begin where the start shows."""
    from gbspec.backends import Evaluator

    with tempfile.TemporaryDirectory() as folder:
        model = _model(Path(folder), tau)
    module = load_module(model)({"constants": np.array([tau, 0.2, 0.1])})
    exact = Evaluator(module).integrate([0.5], TIMES, rtol=1e-11, atol=1e-11)
    lines = ["| largest step | error | error, steps not cut |", "|---:|---:|---:|"]
    for step in STEPS:
        cut, whole = (float(np.abs(_solved(model, tau, step, with_cuts) - exact).max()) for with_cuts in (True, False))
        lines.append(f"| {step:g} | {cut:.2g} | {whole:.2g} |")
    return "\n".join(lines)


def _solved(model: Model, tau: float, step: float, cut: bool) -> Array:
    """The solution of the torch engine at `TIMES`."""
    from dataclasses import replace

    values = np.full((len(TIMES), 1), 0.5)
    item = Trajectory("1", 0.0, TIMES, values, np.ones_like(values), np.full_like(values, np.nan), np.zeros(0))
    data = Trajectories((item,), ("P",))
    packed = pack(data, model, step)
    if not cut:
        doses = packed.doses
        packed = replace(packed, doses=replace(doses, time=np.full_like(doses.time, np.nan)))
    forcing = teacher_forcing(model, packed, 0.0)
    problem = Problem(model, load_module(model)(), packed, forcing, scaling_of(model, packed, data))
    parameters = Parameters(model, np.full((1, 1), 0.5), np.ones(1), np.zeros((1, 1)), {})
    theta = parameters.vector({}, np.array([tau, 0.2, 0.1]))
    engine = Choice().engine(problem, parameters)
    return engine.moments(theta, engine.plan(theta)).mean


def _model(folder: Path, tau: float) -> Model:
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model

    path = folder / "mackey_glass.gb"
    path.write_text(TEXT.format(tau=tau), encoding="utf-8")
    return load_model(path, Findings())


def fits(taus: tuple[float, ...]) -> str:
    """The constants that fits of whole solutions find."""
    import gbspec

    lines = ["| tau | found | beta | gamma | CPU s |", "|---:|---:|---:|---:|---:|"]
    for tau in taus:
        with tempfile.TemporaryDirectory() as folder:
            _model(Path(folder), tau)
            specification = gbspec.load(Path(folder) / "mackey_glass.gb")
            data = specification.simulate(trajectories=1, span=200, dt=2, seed=1)
            begun = time.process_time()
            run = specification.train(data, Path(folder) / "run", seed=0)
            found = run.constants
            spent = time.process_time() - begun
        lines.append(f"| {tau:g} | {found['tau']:.8g} | {found['beta']:.8g} | {found['gamma']:.8g} | {spent:.0f} |")
    return "\n".join(lines)


def _bound(model: Model, data: Trajectories) -> tuple[Problem, Parameters, Array]:
    """Whole solutions with the steps of a fit, at random weights and the declared constants."""
    module = load_module(model).random(0)
    packed = pack(data, model, default_max_step(data))
    problem = Problem(model, module, packed, teacher_forcing(model, packed, 0.0), scaling_of(model, packed, data))
    known = np.array([[0.0 if state.initial.known else 1.0 for state in model.states]])
    shape = len(data), len(model.states)
    fixed = {name: value for name, value in module.weights.items() if name.endswith(("_center", "_scale"))}
    parameters = Parameters(model, np.full(shape, 0.5), np.ones(shape[1]), np.repeat(known, len(data), 0), fixed)
    return problem, parameters, parameters.vector(module.weights)


def _measured(specification: Specification, data: Trajectories, rounds: int) -> Mapping[str, tuple[float, float]]:
    """Processor seconds by the torch graph and by the kernel."""
    model = specification.model
    problem, parameters, theta = _bound(model, data)
    kernel = kernel_of(model, type(problem.module))
    assert isinstance(kernel, Kernel), kernel
    engines = TorchEngine(problem, parameters), NativeEngine(problem, parameters, kernel)
    work: dict[str, Callable[[Engine], object]] = {
        "loss and gradient": lambda engine: half_squares(engine, theta),
        "Jacobian": lambda engine: linearise(engine, theta),
    }
    spent: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in work}
    for name, call in work.items():
        for engine in engines:
            call(engine)
        for _ in range(rounds):
            for engine, own in zip(engines, spent[name], strict=True):
                begun = time.process_time()
                call(engine)
                own.append(time.process_time() - begun)
    return {name: (float(np.median(torch)), float(np.median(own))) for name, (torch, own) in spent.items()}


def _fitted(specification: Specification, data: Trajectories, folder: Path) -> Mapping[str, tuple[float, float]]:
    """Processor seconds of a whole fit by the torch graph and by the kernel."""
    whole = []
    for backend in ("torch", "native"):
        begun = time.process_time()
        specification.train(data, folder / f"{specification.model.name} {backend}", seed=0, members=1, backend=backend)
        whole.append(time.process_time() - begun)
    return {"fit, all options the defaults": (whole[0], whole[1])}


def times(rounds: int, whole: bool) -> str:
    """Processor times by turns: medians of a loss with its gradient and of a Jacobian, or those of a `whole` fit."""
    import gbspec

    lines = ["| model | | torch graph | kernel | ratio |", "|---|---|---:|---:|---:|"]
    with tempfile.TemporaryDirectory() as folder:
        _model(Path(folder), 17.0)
        glass, cells = gbspec.load(Path(folder) / "mackey_glass.gb"), gbspec.load("haematopoiesis")
        given = (
            (glass, glass.simulate(trajectories=1, span=200, dt=2, seed=1)),
            (cells, cells.simulate(trajectories=4, span=80, dt=2, sampling="regular", noise=0.01)),
        )
        for specification, data in given:
            pair = _fitted(specification, data, Path(folder)) if whole else _measured(specification, data, rounds)
            for what, spent in pair.items():
                torch, kernel = (f"{value:.3g} s" if value >= 1 else f"{1e3 * value:.3g} ms" for value in spent)
                name = specification.model.name
                lines.append(f"| `{name}` | {what} | {torch} | {kernel} | {spent[0] / spent[1]:.0f} |")
    return "\n".join(lines)


def main() -> None:
    """Writes the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--taus", type=float, nargs="*", default=[8.0, 17.0, 30.0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--only", choices=("orders", "fits", "times", "whole"), default=None)
    given = parser.parse_args()
    parts = {
        "orders": orders,
        "fits": lambda: fits(tuple(given.taus)),
        "times": lambda: times(given.rounds, whole=False),
        "whole": lambda: times(given.rounds, whole=True),
    }
    found = [part() for name, part in parts.items() if given.only in (None, name)]
    given.output.write_text("\n\n".join(found) + "\n", encoding="utf-8")


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    main()
