"""How often 90 % intervals of constants contain the true ones, in fits to simulated counts.

`python -m benchmarks.studies.counts [--sets 100]` prints, for Poisson and negative binomial counts of one decay (24
values), the part of the intervals of each constant that contain it.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

import gbspec

MODEL = """model decay
time t from 0
state x
learn r = 0.3 in [0.01, 5]
learn x0 = 10 in [1, 1000]
{learn}
x' = -r*x
initial x = x0
observe y = x noise {noise}
"""
TRUE = {"r": 0.5, "x0": 60.0, "k": 5.0}
TIMES = np.linspace(0.25, 6, 24)


def covered(size: float | None, sets: int, folder: Path) -> dict[str, float]:
    """The part of the intervals that contain each constant."""
    noise, learn = ("poisson", "") if size is None else ("negative_binomial(k)", "learn k = 10 in [0.1, 1e4]")
    (folder / "decay.gb").write_text(MODEL.format(noise=noise, learn=learn))
    model = gbspec.load(folder / "decay.gb")
    mean = TRUE["x0"] * np.exp(-TRUE["r"] * TIMES)
    inside: dict[str, list[bool]] = {}
    for number in range(sets):
        random = np.random.default_rng([number, 5])
        values = random.poisson(mean if size is None else random.gamma(size, mean / size))
        lines = [f"{t},{y}" for t, y in zip(TIMES, values, strict=True)]
        (folder / "data.csv").write_text("\n".join(["t,y", *lines]) + "\n")
        run = model.train(folder / "data.csv", folder / f"run{size}{number}", effort="low", progress=False)
        for name, constant in run.run.fit.constants.items():
            low, high = constant.interval or (np.nan, np.nan)
            inside.setdefault(name, []).append(bool(low <= TRUE[name] <= high))
    return {name: float(np.mean(each)) for name, each in inside.items()}


def main() -> None:
    """Prints both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=100)
    sets = parser.parse_args().sets
    with tempfile.TemporaryDirectory() as folder:
        for size in (None, TRUE["k"]):
            found = covered(size, sets, Path(folder))
            listed = ", ".join(f"{name} {100 * part:.0f} %" for name, part in found.items())
            print("Poisson:" if size is None else "negative binomial:", listed, flush=True)


if __name__ == "__main__":
    main()
