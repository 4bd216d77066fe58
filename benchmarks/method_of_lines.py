"""The cost of arrays of states: a training step of a method-of-lines model, computed as vectors or written out.

    python -m benchmarks.method_of_lines [--rounds 5] [--states 32 128 512 2000] [--written-out 32 128]

The bundled `spreading_population` with an MLP 1-32-32-1, 8 trajectories, 20 sub-steps of RK4, float64, one core. A step
is forward and backward through the generated module's torch graph; `written out` has one expression per state. For
comparison: the same step written by hand in torch, and the time of `gbspec check`.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Timing, busyness, clock, interleaved, markdown, parser, process, say, write
from gbspec.backends.module import load_module
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model

TRAJECTORIES, STEPS, STEP = 8, 20, 0.01

Gradients = tuple[Tensor, ...]


def text_of(states: int) -> str:
    """The bundled model with another number of reaches."""
    text = shipped_models()["spreading_population"].read_text(encoding="utf-8")
    return text.replace("const N = 24", f"const N = {states}").replace("mlp(16, 16)", "mlp(32, 32)")


def of_module(path: Path, written_out: bool) -> Callable[[], Gradients]:
    """A step of the generated module."""
    model = load_model(path, Findings())
    instance = load_module(replace(model, arrays=(), families=()) if written_out else model).random(0)
    weights = {name: torch.from_numpy(np.array(value)) for name, value in instance.weights.items()}
    trained = [value.requires_grad_() for name, value in weights.items() if name.endswith(("weight", "bias"))]
    constants = tuple(torch.full((TRAJECTORIES,), value) for value in instance.weights["constants"].tolist())
    math, condition = instance.arithmetic("torch"), torch.ones(TRAJECTORIES, 1)
    grid, start = instance._grid(math, 0.0, torch.full((TRAJECTORIES,), STEP)), begin(len(model.states))

    def step() -> Gradients:
        field, x = instance._field(math, condition, constants, instance.torch_networks(weights)), start
        for _ in range(STEPS):
            x = instance._step(math, field, grid, x, (None, None, None))
        return torch.autograd.grad((x**2).sum(), trained)

    return step


def by_hand(path: Path) -> Callable[[], Gradients]:
    """The same step, written by hand in torch."""
    instance = load_module(load_model(path, Findings())).random(0)
    values = {name: torch.from_numpy(np.array(value)) for name, value in instance.weights.items()}
    trained = [value.requires_grad_() for name, value in values.items() if name.endswith(("weight", "bias"))]
    w1, b1, w2, b2, w3, b3 = trained
    constants = dict(zip(instance.constants, instance.weights["constants"].tolist(), strict=True))
    factor = constants["D"] / constants["h"] ** 2
    center, scale = values["network.g.input_center"], values["network.g.input_scale"]
    start = begin(len(instance.states))

    def rhs(u: Tensor) -> Tensor:
        z = ((u - center) / scale)[..., None]
        a = torch.nn.functional.silu(z @ w1.T + b1)
        g = (torch.nn.functional.silu(a @ w2.T + b2) @ w3.T + b3)[..., 0]
        wide = torch.cat([u[:, :1], u, u[:, -1:]], 1)
        return factor * (wide[:, :-2] - 2 * u + wide[:, 2:]) + g

    def step() -> Gradients:
        x = start
        for _ in range(STEPS):
            k1 = rhs(x)
            k2 = rhs(x + STEP / 2 * k1)
            k3 = rhs(x + STEP / 2 * k2)
            x = x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + rhs(x + STEP * k3))
        return torch.autograd.grad((x**2).sum(), trained)

    return step


def begin(states: int) -> Tensor:
    """The initial state."""
    return torch.linspace(0.1, 0.9, states).expand(TRAJECTORIES, states)


def agree(runs: dict[str, Callable[[], Gradients]]) -> None:
    """Exits unless all runs have the same gradient to 1e-10."""
    (first, wanted), *others = ((name, run()) for name, run in runs.items())
    for name, found in others:
        for a, b in zip(wanted, found, strict=True):
            if float((a - b).abs().max()) > 1e-10 * float(a.abs().max()):
                raise SystemExit(f"{name} and {first} have different gradients")


def case(states: int, written_out: bool, rounds: int) -> dict[str, Any]:
    """Timings at one number of states."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.gb"
        path.write_text(text_of(states), encoding="utf-8")
        runs = {"vectors": of_module(path, False), "by hand": by_hand(path)}
        if written_out:
            runs["written out"] = of_module(path, True)
        agree(runs)
        timings: dict[str, Timing] = interleaved(dict(runs), rounds)
        check = process("-m", "gbspec", "check", "--quiet", str(path))
        seconds = [clock(check)[1] for _ in range(3)]
    found = {name: timing.to_json() for name, timing in timings.items()}
    say(f"{states} states: " + ", ".join(f"{name} {t['ms']:.0f} ms" for name, t in found.items()))
    return {"states": states, "busyness": busyness(timings), "timings": found, "check_cpu_s": float(np.median(seconds))}


def table(cases: list[dict[str, Any]]) -> str:
    """One row per number of states: processor time, which other processes affect less than wall time."""
    names = ("by hand", "vectors", "written out")
    rows = [
        [
            str(found["states"]),
            *(f"{found['timings'][name]['cpu_ms']:.0f}" if name in found["timings"] else "" for name in names),
            f"{found['check_cpu_s']:.1f}",
        ]
        for found in cases
    ]
    return markdown(["states", *(f"{name}, cpu ms" for name in names), "check, cpu s"], rows)


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--states", type=int, nargs="+", default=[32, 128, 512, 2000])
    options.add_argument("--written-out", type=int, nargs="*", default=[32, 128])
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes method_of_lines.md and method_of_lines.json."""
    options = arguments()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    cases = [case(states, states in options.written_out, options.rounds) for states in options.states]
    write("method_of_lines", "What arrays of states cost", table(cases), {"cases": cases}, options.output)


if __name__ == "__main__":
    main()
