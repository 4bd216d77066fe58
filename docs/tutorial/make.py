"""Makes the tables of the tutorial: a tank with an outlet, and an overflow at 1.2 m of which the reader is not told.

    python docs/tutorial/make.py

The level is measured about every quarter of an hour with a standard deviation of 8 mm. tank.csv has six experiments,
later.csv one with another course of the inflow.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

HERE = Path(__file__).parent
AREA, NOISE = 0.8, 0.008
STARTS = (0.2, 0.9, 1.7, 0.5, 1.4, 0.1)


def outflow(level: float) -> float:
    """What leaves the tank in an hour, m3."""
    return float(0.9 * np.sqrt(max(level, 0.0)) + 2.5 * max(level - 1.2, 0.0) ** 1.5)


def experiment(label: str, start: float, inflows: NDArray[np.float64], rng: np.random.Generator) -> list[str]:
    """The rows of one experiment; the inflow changes every hour and a half."""
    times = np.concatenate([[0.0], np.cumsum(rng.gamma(4, 0.25 / 4, 23))])
    level, now, rows = start, 0.0, []
    for time in times:
        while now < time:
            piece = int((now + 1e-9) / 1.5)
            end = min(time, 1.5 * (piece + 1))
            flow = inflows[min(piece, len(inflows) - 1)]
            solved = solve_ivp(lambda t, x, f=flow: [(f - outflow(x[0])) / AREA], (now, end), [level], rtol=1e-9)
            level, now = float(solved.y[0, -1]), end
        flow = inflows[min(int((time + 1e-9) / 1.5), len(inflows) - 1)]
        rows.append((time, flow, level + NOISE * rng.standard_normal()))
    changes = [(1.5 * k, flow, None) for k, flow in enumerate(inflows) if 0 < 1.5 * k < times[-1]]
    merged = sorted([*rows, *changes], key=lambda row: row[0])
    return [f"{label},{t:.3f},{f:.2f},{'' if h is None else f'{h:.3f}'}" for t, f, h in merged]


def main() -> None:
    """Writes both tables."""
    rng = np.random.default_rng(7)
    lines = ["trajectory,t,F,h"]
    for number, start in enumerate(STARTS, 1):
        lines += experiment(str(number), start, rng.uniform(0.1, 1.9, 5), rng)
    (HERE / "tank.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    later = ["trajectory,t,F,h", *experiment("later", 0.6, np.array([1.6, 0.3, 1.2, 1.8, 0.5]), rng)]
    (HERE / "later.csv").write_text("\n".join(later) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
