"""The cost of contracts: a training step with them compared with one of the plain network, in interleaved runs.

    python -m benchmarks.contracts [--repeats 15] [--only CONTRACTS ...]

Workload: URP (two states, network 3-64-64-1), 200 trajectories over [0, 10], measured about every 0.5, RK4 with step
0.1, one thread, float64, processor time. "kernel" and "graph" are the loss and its gradient (a step of Adam) by
the native kernel, which training uses if there is a compiler, and by the torch graph; "Jacobian" (a step of
Levenberg-Marquardt) the exact derivatives of all residuals, on a tenth of the trajectories. Prints medians, and the
median of the ratios of neighbouring runs.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.harness import clock
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.training.engines.objective import linearise, objective
from gbspec.training.options import TrainOptions
from gbspec.training.recipe.context import build_context

TEXT = """model urp
state x1 in [0, 1]
state x2 in [0, 8]
condition Da in [0.2, 0.5]
learn B = 5 in [0, 50]
learn beta = 1 in [0, 10]
unknown phi({arguments}){contracts} by mlp(64, 64)
x1' = -x1 + phi
x2' = -x2 + B*phi - beta*x2
observe x1
observe x2
"""

MONOTONE = "decreasing in x1, increasing in x2, increasing in Da"

CONTRACTS = {
    "plain": "",
    ">= 0": " >= 0",
    "in [0, 3]": " in [0, 3]",
    "zero at Da = 0": " zero at Da = 0",
    "decreasing in x1": " decreasing in x1",
    ">= 0, monotone in all": f" >= 0, {MONOTONE}",
    ">= 0, zero at Da = 0, monotone in all": f" >= 0, zero at Da = 0, {MONOTONE}",
    "= Da*(1 - x1)*nn, the same": " >= 0, zero at x1 = 1, decreasing in x1, increasing in x2 = Da*(1 - x1)*nn",
    "zero at Da = 0.35, increasing in Da": " zero at Da = 0.35, increasing in Da",
    "of x2 alone": "",
    "of x2 alone, zero at 2, increasing": " zero at x2 = 2, increasing in x2",
}

ALONE = "of x2 alone"


def model_of(contracts: str, arguments: str) -> Model:
    text = TEXT.format(contracts=contracts, arguments=arguments)
    return load_model("urp.gb", Findings(), lambda path: Source(str(path), text))


def data(count: int) -> Trajectories:
    """Values that keep the solver in the usual region; the measured values do not affect the cost."""
    rng = np.random.default_rng(0)
    items = []
    for i in range(count):
        times = np.cumsum(rng.gamma(4, 0.125, 20))
        values = np.stack([rng.uniform(0.1, 0.9, 20), rng.uniform(0.5, 3.5, 20)], 1)
        blank = np.full_like(values, np.nan)
        values[np.arange(20), rng.integers(0, 2, 20)] = np.nan
        items.append(
            Trajectory(
                str(i),
                0.0,
                times,
                values,
                np.isfinite(values).astype(float),
                blank,
                np.array([rng.uniform(0.2, 0.5)]),
                (),
            )
        )
    return Trajectories(tuple(items), ("x1", "x2"))


def steps(model: Model, trajectories: Trajectories) -> tuple[Callable[[], object], ...]:
    """The loss and its gradient by the native kernel and by the torch graph, and one Jacobian."""
    options = TrainOptions(max_step=0.1)
    context = build_context(model, load_module(model), trajectories, options, 0)
    fixed = {k: v for k, v in context.module.weights.items() if "center" in k or "scale" in k}
    parameters = context.parameters(fixed)
    problem = context.problem()
    theta = parameters.vector(context.module.weights)
    few = np.arange(max(1, len(trajectories) // 10))
    small = context.choice.engine(problem.take(few), parameters.take(few))
    kernel, graph = (objective(problem, parameters, backend) for backend in ("native", "torch"))
    return (
        lambda: kernel(theta),
        lambda: graph(theta),
        lambda: linearise(small, parameters.take_vector(theta, few)),
    )


def seconds(step: Callable[[], object]) -> float:
    return clock(step)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--only", nargs="*", default=list(CONTRACTS), metavar="CONTRACTS", choices=list(CONTRACTS))
    chosen = parser.parse_args()
    repeats = chosen.repeats
    torch.set_num_threads(1)
    trajectories = data(200)
    candidates = {
        name: steps(model_of(text, "x2" if name.startswith(ALONE) else "x1, x2, Da"), trajectories)
        for name, text in CONTRACTS.items()
        if name in (*chosen.only, "plain", ALONE)
    }
    print(
        f"{'contracts on phi':<42}" + "".join(f" {what:>10} {'x plain':>8}" for what in ("kernel", "graph", "Jacobian"))
    )
    for name, kinds in candidates.items():
        texts = []
        base = candidates[ALONE if name.startswith(ALONE) else "plain"]
        for plain, step in zip(base, kinds, strict=True):
            seconds(plain), seconds(step)
            both = [(seconds(plain), seconds(step)) for _ in range(repeats)]
            ratio = statistics.median(b / a for a, b in both)
            texts.append(f"{1e3 * statistics.median(b for _, b in both):>7.1f} ms {ratio:>8.2f}")
        print(f"{name:<42} {' '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
