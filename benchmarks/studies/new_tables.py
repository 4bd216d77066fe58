"""Tables that no one tuned gbspec for: first natural models with default options.

    python -m benchmarks.studies.new_tables DATA -o out [--parts flexhouse,tclab]

DATA is a folder with flexhouse.csv, phenobarbital.csv, tclab.csv and emps.csv; the models are in new_tables/. Each part
is a fit, stored in OUT and not repeated by the same command; OUT/new_tables.md has constants with intervals, how whole
solutions follow the data, and what is said of their residuals. Of tclab and emps some trajectories are fitted and the
others predicted from the rows of a window; of tclab the best linear model of two states, fitted by scipy to the same
rows, predicts them too.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gbspec.analysis import Forecast
    from gbspec.arrays import Array
    from gbspec.data import Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Run

MODELS = Path(__file__).with_name("new_tables")
STARTS = ((0.001, 0.007), (0.02, 0.05), (0.01, 0.01))
"""Starting values of the linear model: the coupling and the speed of the sensor."""


@dataclass(frozen=True)
class Part:
    """A fit: the table, and the trajectories that are fitted (none: all); the others are predicted."""

    table: str
    fitted: tuple[str, ...] = ()
    linear: bool = False


PARTS = {
    "phenobarbital": Part("phenobarbital"),
    "phenobarbital_each": Part("phenobarbital"),
    "flexhouse": Part("flexhouse"),
    "flexhouse_heater": Part("flexhouse"),
    "tclab": Part("tclab", ("sine_5_1", "step_1"), linear=True),
    "tclab_exchange": Part("tclab", ("sine_5_1", "step_1"), linear=True),
    "emps": Part("emps", ("estimation",)),
    "emps_known": Part("emps", ("estimation",)),
}


@dataclass(frozen=True)
class Result:
    """A part's run, and the predictions of what was not fitted."""

    run: Run
    predicted: Forecast | None
    linear: dict[str, float]


def computed(name: str, data: Path, out: Path) -> Result:
    """A part, fitted or read from `out`."""
    from gbspec import frontend
    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, fitting, tables
    from gbspec.runs import member_numbers, open_run
    from gbspec.training import TrainOptions

    part, directory = PARTS[name], out / name
    model = frontend.load_model(MODELS / f"{name}.gb", Findings())
    table = tables.read_data(data / f"{part.table}.csv", model, Findings())
    known, new = divided(table, part)
    done = member_numbers(directory)
    run = open_run(directory) if done else fitting.train(model, known, directory, TrainOptions(workers=1))
    predicted = analysing.predict(run, new, path=out / f"{name}.csv") if new is not None else None
    linear = linear_errors(model, known, new, predicted) if part.linear and new is not None and predicted else {}
    return Result(run, predicted, linear)


def divided(table: Trajectories, part: Part) -> tuple[Trajectories, Trajectories | None]:
    """The trajectories that are fitted, and those that are predicted."""
    from gbspec.data import Trajectories

    if not part.fitted:
        return table, None
    groups = [[i for i in table.items if (i.label in part.fitted) == fitted] for fitted in (True, False)]
    known, new = (Trajectories(tuple(group), table.channels) for group in groups)
    return known, new


# ------------------------------------------------------------------------------------- a linear model of two states
def linear_errors(model: Model, known: Trajectories, new: Trajectories, predicted: Forecast) -> dict[str, float]:
    """Root mean square errors of the best linear model in the rows that were not used, by trajectory.

    H' = a Q - b H + c (S - H), S' = d (H - S) - e S, both measured from the temperature of the room, which is fitted
    for each trajectory: in training to all rows, then to those of the window.
    """
    from scipy.optimize import least_squares

    def misfit(logarithms: Array) -> Array:
        return np.concatenate([centred(item.values[:, 0] - response(logarithms, item)) for item in known.items])

    starts = [np.log([0.04, 0.01, coupling, speed, 1e-4]) for coupling, speed in STARTS]
    best = min((least_squares(misfit, start) for start in starts), key=lambda found: float(found.cost))
    found = {}
    for item, shown in zip(new.items, predicted.items, strict=True):
        off = item.values[:, 0] - response(best.x, item)
        window = np.array([use == "window" for use in shown.used])
        found[item.label] = float(np.sqrt(np.mean((off - off[window].mean())[~window] ** 2)))
    return found


def centred(values: Array) -> Array:
    """Values minus their mean."""
    return np.asarray(values - values.mean())


def response(logarithms: Array, item: Trajectory) -> Array:
    """The sensor's temperature above the room's at the rows of a trajectory, whose power is held between them."""
    from scipy.linalg import expm

    a, b, c, d, e = np.exp(logarithms)
    whole = np.array([[-b - c, c, a], [d, -d - e, 0.0], [0.0, 0.0, 0.0]])
    steps = np.round(np.diff(item.times), 4)
    maps = {step: expm(whole * step) for step in np.unique(steps)}
    power = item.inputs[0].values[np.searchsorted(item.inputs[0].times, item.times[:-1] + 1e-9) - 1]
    state, heights = np.zeros(2), [0.0]
    for step, held in zip(steps, power, strict=True):
        state = maps[step][:2, :2] @ state + maps[step][:2, 2] * held
        heights.append(float(state[1]))
    return np.array(heights)


# ------------------------------------------------------------------------------------------------------- the tables
def tables_of(results: dict[str, Result]) -> list[str]:
    """The lines of the document."""
    lines = ["| model | constant | value | 90 % interval |", "|---|---|---:|---|"]
    for name, result in results.items():
        for constant, one in result.run.fit.constants.items():
            ends = f"{one.interval[0]:.4g} to {one.interval[1]:.4g}" if one.interval else "-"
            own = [single.interval for single in (one.per_trajectory or {}).values()]
            if own:
                ends = f"{sum(ends_of is not None for ends_of in own)} of {len(own)} trajectories have one"
            lines.append(f"| {name} | {constant} | {one.value:.4g} | {ends} |")
    lines += ["", "| model | channel | rmse | R² | naive R² | noise | correlation of successive residuals |",
              "|---|---|---:|---:|---:|---:|---:|"]  # fmt: skip
    for name, result in results.items():
        member = result.run.fit.members[0]
        for channel, each in (member.channels or {}).items():
            cells = (member.rmse[channel], each.r2, each.naive, result.run.fit.noise[channel], each.autocorrelation)
            shown = " | ".join("-" if cell is None else f"{cell:.5g}" for cell in cells)
            lines.append(f"| {name} | {channel} | {shown} |")
    lines += ["", "| model | predicted | rmse | inside the 90 % intervals | rmse of the linear model |",
              "|---|---|---:|---:|---:|"]  # fmt: skip
    for name, result in results.items():
        lines += predictions_of(name, result)
    warned = [f"- {name}: {text}" for name, result in results.items() for text in result.run.fit.warnings]
    return [*lines, "", *warned]


def predictions_of(name: str, result: Result) -> Sequence[str]:
    """A line for each predicted trajectory: errors in the rows after the window."""
    lines = []
    for item in result.predicted.items if result.predicted is not None else ():
        later = np.array([use == "predicted" for use in item.used])
        off = (item.measured - item.mean[:, : item.measured.shape[1]])[later, 0]
        low, high = (ends[later, 0] <= item.measured[later, 0] for ends in (item.low, item.high))
        linear = f"{result.linear[item.label]:.3g}" if item.label in result.linear else "-"
        inside = 100 * float(np.mean(low & ~high))
        lines.append(f"| {name} | {item.label} | {float(np.sqrt(np.mean(off**2))):.3g} | {inside:.0f} % | {linear} |")
    return lines


def main() -> None:
    """Computes the parts that are asked for and writes the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--parts", default=",".join(PARTS))
    asked = parser.parse_args()
    results = {name: computed(name, asked.data, asked.output) for name in asked.parts.split(",")}
    document = asked.output / "new_tables.md"
    document.write_text("\n".join(tables_of(results)) + "\n", encoding="utf-8")
    print(document.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
