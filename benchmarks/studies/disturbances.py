"""Models with random disturbances: sets with known truth, and a measured room.

    python -m benchmarks.studies.disturbances DATA -o OUT --parts process,lotka_volterra,friction_oscillator --sets 100
    python -m benchmarks.studies.disturbances DATA -o OUT --parts friction_oscillator_score --sets 40
    python -m benchmarks.studies.disturbances DATA -o OUT --parts flexhouse
    python -m benchmarks.studies.disturbances DATA -o OUT --table docs/studies/disturbances.md

DATA is a folder with flexhouse.csv. A set is simulated and fitted with the defaults; its row is added
to OUT/sets.csv as soon as its fit is done, and the same command run again continues with the missing ones. Fits of
measured data are runs in OUT, which are not fitted again. MODEL_score is the score of so many sets together at the
truth: one step of the fit's method from there, which shows a bias of the likelihood in a fraction of the time of fits.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import time
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gbspec.ir import Model
    from gbspec.operations.models import Subject

HERE = Path(__file__).with_suffix("")
TRUTH = {
    "process": {"theta": 1.0, "mu": 1.0, "s": 0.5},
    "lotka_volterra": {"a": 1.0, "b": 0.5, "c": 1.0, "d": 0.3, "sx": 0.1, "sy": 0.1},
    "friction_oscillator": {"k": 4.0, "dry": 0.6, "viscous": 0.15, "s": 0.3},
}
DESIGN = {
    "process": (200.0, 0.5, 0.1),
    "lotka_volterra": (30.0, 0.5, 0.05),
    "friction_oscillator": (60.0, 0.25, 0.05),
}
"""Span, interval and noise of a set: that of `process` lasts 200 relaxation times."""
ROOMS = ("flexhouse_ti", "flexhouse_titeth", "flexhouse_clouds", "flexhouse_aperture", "flexhouse_switches")
SWITCH, LONGEST = 2.5, 0.67
"""A change of the heater's power by more is a switch (kW); times since the last one are at most so long (h)."""
FIELDS = ("model", "set", "constant", "truth", "value", "sd", "low", "high", "seconds")


def simulated(names: Sequence[str], count: int, out: Path) -> None:
    """Fits of sets that are simulated from the models' truths: one set of each model, then the next of each."""
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.operations import models

    loaded = {name: load_model(HERE / f"{name}.gb", Findings()) for name in names}
    references, table = {name: models.reference(model) for name, model in loaded.items()}, out / "sets.csv"
    done = {(row["model"], int(row["set"])) for row in rows_of(table)}
    for number, name in product(range(count), names):
        if (name, number) not in done:
            found = _set(loaded[name], references[name], name, number, out)
            with table.open("a", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                if file.tell() == 0:
                    writer.writerow(FIELDS)
                writer.writerows(found)


def _set(model: Model, reference: Subject, name: str, number: int, out: Path) -> list[tuple[object, ...]]:
    """The rows of one set."""
    from gbspec.analysis import simulate
    from gbspec.data import SimulateOptions
    from gbspec.training import TrainOptions, train

    span, step, noise = DESIGN[name]
    options = SimulateOptions(trajectories=1, span=span, dt=step, noise=noise, seed=number)
    data = simulate(reference.evaluator, reference.model, options)
    place = out / f"{name}_{number}"
    if place.is_dir():  # a fit that was interrupted
        shutil.rmtree(place)
    began = time.process_time()
    run = train(model, data, TrainOptions(), place)
    seconds, found = round(time.process_time() - began, 1), []
    for constant, truth in TRUTH[name].items():
        one = run.fit.constants[constant]
        low, high = one.interval or (float("nan"), float("nan"))
        found.append((name, number, constant, truth, one.value, one.sd, low, high, seconds))
    return found


def score(name: str, count: int, out: Path) -> None:
    """One step of Fisher scoring from the truth for `count` sets together, noises estimated: OUT/NAME_score.json."""
    from gbspec.analysis import simulate
    from gbspec.backends import load_module
    from gbspec.data import SimulateOptions
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.ir import METHODS
    from gbspec.operations import models
    from gbspec.training import TrainOptions
    from gbspec.training.engines import FilterEngine
    from gbspec.training.recipe import build_context

    model, (span, step, noise) = load_model(HERE / f"{name}.gb", Findings()), DESIGN[name]
    reference = models.reference(model)
    options = SimulateOptions(trajectories=count, span=span, dt=step, noise=noise, seed=1234)
    data = simulate(reference.evaluator, reference.model, options)
    context = build_context(model, load_module(model, METHODS["rk4"]), data, TrainOptions(backend="torch"), 0)
    parameters = context.parameters({})
    engine = FilterEngine.of(context.problem(0.0), parameters)
    theta, names = parameters.vector(context.module.weights).copy(), [k.name for k in model.learnables]
    truths = {index: TRUTH[name][names[index]] for index in parameters.shared}
    begin = parameters.n_weights
    for place, (index, truth) in enumerate(truths.items()):
        theta[begin + place] = parameters.bijections((index,)).from_natural(np.array([truth]))[0]
    vector, noises = np.concatenate([theta, engine.noise.first()]), len(theta) + np.arange(len(engine.noise.learned))
    for _ in range(8 if len(noises) else 0):
        found = engine.information(vector)
        move = np.linalg.solve(found.matrix[np.ix_(noises, noises)], found.gradient[noises])
        vector[noises] -= np.clip(move, -1, 1)
    found, free = engine.information(vector), np.flatnonzero(engine.layout.free > 0)
    inverse = np.linalg.inv(found.matrix[np.ix_(free, free)])
    move, sd = -inverse @ found.gradient[free], np.sqrt(np.diag(inverse))
    document: dict[str, object] = {"sets": count}
    for place, index in enumerate(truths):
        at = int(np.flatnonzero(free == begin + place)[0])
        document[names[index]] = {"errors": move[at] / sd[at], "sd_of_a_set": move[at] / sd[at] / np.sqrt(count)}
    (out / f"{name}_score.json").write_text(json.dumps(document, indent=1), encoding="utf-8")


def rows_of(table: Path) -> list[dict[str, str]]:
    """The rows of a table; none if it does not exist."""
    if not table.is_file():
        return []
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def rooms(data: Path, out: Path, names: Iterable[str]) -> None:
    """Fits of the room, and their likelihoods with another variance of the start."""
    from gbspec.data import read
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.runs import open_run
    from gbspec.training import TrainOptions, filter_run, train
    from gbspec.training.engines import FilterEngine

    document, rows = {}, switches(data / "flexhouse.csv", out / "flexhouse.csv")
    for name in names:
        model = load_model(HERE / f"{name}.gb", Findings())
        table = read(rows, model, Findings())
        place = out / name
        run = open_run(place) if (place / "fit.json").is_file() else train(model, table, TrainOptions(), place)
        filtered, tested = filter_run(run, table, 0), filter_run(run, table, 0).whiteness(0)
        engine = filtered.engine
        # The variance that the disturbances bring in one interval, as in CTSM, instead of the sizes of the states.
        known = {k.symbol: run.fit.constants[k.name].value for k in model.learnables}
        known |= {u.symbol: 0.0 for u in model.inputs}
        spread = [float(d.value.subs(known)) for d in model.diffusions]
        interval = float(np.median(np.diff(table.items[0].times)))
        variance = np.array([[s**2 * interval for s in spread]])
        narrow = FilterEngine(engine.problem, engine.parameters, np.maximum(variance, 1e-6))
        document[name] = {
            "likelihood": -filtered.found.value,
            "narrow": _best_start(narrow, filtered.vector, filtered),
            "p": None if tested is None else tested.p,
            "robust_p": None if tested is None else tested.robust_p,
            "periodogram_p": None if tested is None else tested.distance_p,
            "parameters": run.fit.members[0].likelihood.parameters if run.fit.members[0].likelihood else None,
            "seconds": run.fit.members[0].seconds,
            "constants": {key: one.value for key, one in run.fit.constants.items()},
        }
    (out / "flexhouse.json").write_text(json.dumps(document, indent=1), encoding="utf-8")


def switches(source: Path, out: Path) -> Path:
    """The table with the time since the heater's last switch (`since`) and the mean of the sun at the ends of each
    interval (`Pm`)."""
    rows = rows_of(source)
    since, power = -LONGEST, float(rows[0]["Ph"])
    for row, following in zip(rows, [*rows[1:], rows[-1]], strict=True):
        time, now = float(row["t"]), float(row["Ph"])
        since, power = time if abs(now - power) > SWITCH else since, now
        row["since"] = f"{min(time - since, LONGEST):.6g}"
        row["Pm"] = f"{(float(row['Ps']) + float(following['Ps'])) / 2:.7g}"
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return out


def _best_start(engine: object, vector: np.ndarray, filtered: object) -> float:
    """The log likelihood with these variances around the smoothed start."""
    from dataclasses import replace

    from gbspec.training import FilteredRun
    from gbspec.training.engines import FilterEngine

    assert isinstance(engine, FilterEngine)
    assert isinstance(filtered, FilteredRun)
    start = filtered.engine.coordinates.states(filtered.engine.smoothed_start(filtered.found))
    moved = replace(engine, parameters=replace(engine.parameters, start_value=start))
    return -moved.value(vector)


def table(out: Path) -> str:
    """The page."""
    lines = ["# Random disturbances", ""]
    lines += [f"`{line.strip()}`  " for line in (__doc__ or "").splitlines() if line.startswith("    python")]
    lines += [
        "",
        "Simulated sets, fitted with the defaults. `bias`: mean error over its standard error; `z`: root mean ",
    ]
    lines[-1] += "square error over the reported standard deviation (1 is right); `inside`: share of 90 % intervals."
    lines += ["", "| model | sets | constant | truth | mean | bias | z | inside | CPU s a fit |"]
    lines += ["|---|---:|---|---:|---:|---:|---:|---:|---:|"]
    rows = rows_of(out / "sets.csv")
    for model, constants in TRUTH.items():
        for constant, truth in constants.items():
            mine = [r for r in rows if (r["model"], r["constant"]) == (model, constant)]
            if not mine:
                continue
            value, sd, low, high = (
                np.array([float(r[key] or "nan") for r in mine]) for key in ("value", "sd", "low", "high")
            )
            error = value - truth
            bias = error.mean() / (error.std(ddof=1) / np.sqrt(len(mine))) if len(mine) > 1 else float("nan")
            inside = np.mean((low <= truth) & (truth <= high))
            z = np.sqrt(np.nanmean((error / sd) ** 2))
            seconds = np.mean([float(r["seconds"]) for r in mine])
            lines.append(
                f"| {model} | {len(mine)} | {constant} | {truth} | {value.mean():.4g} | {bias:+.2f} | {z:.2f} "
                f"| {100 * inside:.0f} % | {seconds:.0f} |"
            )
    lines += _rooms_table(out)
    return "\n".join(lines) + "\n"


def _rooms_table(out: Path) -> list[str]:
    if not (out / "flexhouse.json").is_file():
        return []
    found = json.loads((out / "flexhouse.json").read_text(encoding="utf-8"))
    lines = [
        "",
        "flexhouse.csv, held inputs, 1,691 rows (Bacher and Madsen 2011). The log likelihood with the default ",
    ]
    lines[-1] += (
        "variance of the start, and with that of one interval (P0 = s^2 dt, at least 1e-6) around the smoothed "
    )
    lines[-1] += (
        "start; probabilities of the innovations' Ljung-Box statistic (20 lags; robust: where variances "
        "change in time) and cumulated periodogram."
    )
    lines += [
        "",
        "| model | parameters | log likelihood | with narrow P0 | Ljung-Box p | robust p | periodogram p | Ci | Ce ",
    ]
    lines[-1] += "| Rie | Rea | wall s |"
    lines += ["|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|"]
    for name, one in found.items():
        values = " | ".join(
            f"{one['constants'][key]:.3g}" if key in one["constants"] else "-" for key in ("Ci", "Ce", "Rie", "Rea")
        )
        lines.append(
            f"| {name} | {one['parameters']} | {one['likelihood']:.1f} | {one['narrow']:.1f} | {one['p']:.2g} "
            f"| {one['robust_p']:.2g} | {one['periodogram_p']:.2g} | {values} | {one['seconds']:.0f} |"
        )
    return lines


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--parts", default="")
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--table", type=Path)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    parts = list(filter(None, given.parts.split(",")))
    simulated([part for part in parts if part in TRUTH], given.sets, given.out)
    for part in parts:
        if part in TRUTH:
            continue
        if part.removesuffix("_score") in TRUTH:
            score(part.removesuffix("_score"), given.sets, given.out)
        elif part == "flexhouse":
            rooms(given.data, given.out, [name for name in ROOMS if (HERE / f"{name}.gb").is_file()])
        else:
            raise SystemExit(f"there is no part `{part}`")
    if given.table is not None:
        given.table.write_text(table(given.out), encoding="utf-8")


if __name__ == "__main__":
    main()
