"""POLLU: 25 rates of 20 species of an air pollution model, from values of all species within an hour.

    python -m benchmarks.studies.pollu -o pollu

The reactions, rates and starts are those of the Test Set for IVP Solvers (Mazzia and Magherini 2008). Data: all 20
species at 40 times from 1e-4 to 60 min, spread logarithmically, with normal noise of `--noise` times the largest value
of each species, which is given to the fit as a standard deviation. The starts of the rates are wrong by up to a factor
of three, their bounds are two decades on either side. All options of the fit are the defaults but `--stages "least
squares; finer step"`: all species are measured, so that gradient matching begins near the minimum, which a search would
only confirm (`--search` runs it).

Not every rate can be told from such data. So the fit's covariance of the logarithms is split into its principal
combinations. Where the standard deviation of one is above 0.1 the fit is free to be far from the truth along a valley
that bends, and its linearised combinations say nothing of the others. The rate with the largest share in such a
combination is named, given its true value, and the rest is fitted again, until no such combination is left. The
combinations whose predicted standard deviation is below 1e-4 are then compared with the truth.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.studies.stiff import exact

RATES = (
    *(0.35, 26.6, 1.23e4, 8.6e-4, 8.2e-4, 1.5e4, 1.3e-4, 2.4e4, 1.65e4, 9.0e3, 0.022, 1.2e4, 1.88),
    *(1.63e4, 4.8e6, 3.5e-4, 0.0175, 1.0e8, 4.44e11, 1.24e3, 2.1, 5.78, 0.0474, 1.78e3, 3.12),
)
TRUTH = {f"k{i}": rate for i, rate in enumerate(RATES, 1)}
REACTANTS = (
    *((1,), (2, 4), (5, 2), (7,), (7,), (7, 6), (9,), (9, 6), (11, 2), (11, 1), (13,), (10, 2), (14,)),
    *((1, 6), (3,), (4,), (4,), (16,), (16,), (17, 6), (19,), (19,), (1, 4), (19, 1), (20,)),
)
CHANGES = {
    1: (-1, -10, -14, -23, -24, 2, 3, 9, 11, 12, 22, 25),
    2: (-2, -3, -9, -12, 1, 21),
    3: (-15, 1, 17, 19, 22),
    4: (-2, -16, -17, -23, 15),
    5: (-3, 4, 4, 6, 7, 13, 20),
    6: (-6, -8, -14, -20, 3, 18, 18),
    7: (-4, -5, -6, 13),
    8: (4, 5, 6, 7),
    9: (-7, -8),
    10: (-12, 7, 9),
    11: (-9, -10, 8, 11),
    12: (9,),
    13: (-11, 10),
    14: (-13, 12),
    15: (14,),
    16: (-18, -19, 16),
    17: (-20,),
    18: (20,),
    19: (-21, -22, -24, 23, 25),
    20: (-25, 24),
}
"""The reactions that consume (negative) and produce each species, as often as they do."""
STARTS = {2: 0.2, 4: 0.04, 7: 0.1, 8: 0.3, 9: 0.01, 17: 0.007}
REFERENCE = {1: 0.5646255480022769e-1, 2: 0.1342484130422339, 7: 0.7784249118997964e-1, 20: 0.5682943292316392e-4}
"""Published values at the end, of some species."""
TIMES = np.logspace(-4, np.log10(60.0), 40)
SHARP, LOOSE = 1e-4, 0.1


def text(seed: int, given: Sequence[str] = ()) -> str:
    """The model, with starts of the rates that are wrong; those of `given` are known."""
    rng = np.random.default_rng(seed)
    lines = ["model pollu", "time t from 0", *(f"state y{i}" for i in CHANGES)]
    for i, rate in enumerate(RATES, 1):
        wrong = rate * 3.0 ** rng.uniform(-1, 1)
        known = f"const k{i} = {rate}"
        lines.append(known if f"k{i}" in given else f"learn k{i} = {wrong:.4g} in [{rate / 100:.4g}, {rate * 100:.4g}]")
    for i, species in enumerate(REACTANTS, 1):
        lines.append(f"let r{i} = k{i}*{'*'.join(f'y{j}' for j in species)}")
    for i, changes in CHANGES.items():
        terms = " ".join(f"{'-' if c < 0 else '+'} r{abs(c)}" for c in changes)
        lines.append(f"y{i}' = {terms.removeprefix('+ ')}")
    lines += [f"initial y{i} = {STARTS.get(i, 0)}" for i in CHANGES] + [f"observe y{i}" for i in CHANGES]
    return "\n".join([*lines, *(f"truth {k} = {rate}" for k, rate in TRUTH.items() if k not in given), ""])


def combinations(covariance: Any, found: dict[str, float]) -> list[dict[str, Any]]:
    """The principal combinations of the logarithms, sharpest first: predicted deviation, distance from the truth in
    these, and the rates with the largest shares."""
    names, values = list(found), np.array(list(found.values()))
    sizes, vectors = np.linalg.eigh(covariance / np.outer(values, values))
    away = np.log(values / np.array([TRUTH[name] for name in names])) @ vectors
    sd = np.sqrt(np.maximum(sizes, 0.0))
    out = []
    for i in range(len(sd)):
        share = vectors[:, i] ** 2
        named = [names[j] for j in np.argsort(-share)[:4] if share[j] > 0.1]
        out.append({"sd": float(sd[i]), "away": float(abs(away[i]) / sd[i]) if sd[i] else np.nan, "rates": named})
    return out


class Heard:
    """Prints what a fit says."""

    def update(self, update: Any) -> None:
        """One iteration."""
        print(update.stage, update.iteration, update.loss, f"{time.process_time():.0f} CPU s", flush=True)

    def message(self, text: str) -> None:
        """A line for the user."""
        print(text, flush=True)


def study(place: Path, noise: float, seed: int, search: bool) -> dict[str, Any]:
    """Fits until no combination is loose; the results of the last of them."""
    given: list[str] = []
    while True:
        result = fit(place / f"{len(given)}_given", noise, seed, search, given)
        loose = [c for c in result["combinations"] if c["sd"] > LOOSE]
        result["fits"], result["given"] = len(given) + 1, list(given)
        if not loose:
            return result
        given.append(str(loose[-1]["rates"][0]))


def fit(place: Path, noise: float, seed: int, search: bool, given: Sequence[str]) -> dict[str, Any]:
    """One fit, with some rates known."""
    from gbspec.data import Trajectories, Trajectory
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.operations import fitting
    from gbspec.runs import read_certainties
    from gbspec.training import TrainOptions

    place.mkdir(parents=True)
    path = place / "pollu.gb"
    path.write_text(text(seed, given), encoding="utf-8")
    model = load_model(str(path), Findings())
    states = exact(model, TIMES)
    reference = max(abs(states[-1, i - 1] / value - 1) for i, value in REFERENCE.items())
    sd = np.broadcast_to(noise * np.abs(states).max(axis=0), states.shape).copy()
    values = states + sd * np.random.default_rng([seed, 1]).standard_normal(states.shape)
    row = Trajectory("0", 0.0, TIMES, values, np.ones_like(values), sd, np.zeros(0))
    data = Trajectories((row,), tuple(channel.name for channel in model.channels))
    began = time.process_time()
    options = TrainOptions(threads=1, workers=1, stages=None if search else "least squares; finer step")
    run = fitting.fit(model, data, place / "run", options, Heard())
    seconds = time.process_time() - began
    found = {name: constant.value for name, constant in run.fit.constants.items()}
    covariance = read_certainties(place / "run" / "members" / "0").covariance
    return {
        "reference": reference,
        "seconds": seconds,
        "solver": run.fit.solver,
        "loss": run.fit.members[0].loss,
        "ratios": {name: value / TRUTH[name] for name, value in found.items()},
        "combinations": [] if covariance is None else combinations(covariance.conditional, found),
        "warnings": list(run.fit.warnings),
    }


def table(result: dict[str, Any]) -> str:
    """The text of the documentation."""
    sharp = [c for c in result["combinations"] if c["sd"] < SHARP]
    known = " and ".join(f"`{name}`" for name in result["given"]) or "no rate"
    lines = [
        f"Solution against the published end: {result['reference']:.1e}. Solver `{result['solver']}`, "
        f"{result['seconds']:.0f} CPU s, loss {result['loss']:.3g}; {known} given, after {result['fits'] - 1} "
        f"fits with a combination that the data leave open by more than a factor of {1 + LOOSE:g}.",
        "",
        f"{len(sharp)} combinations have a predicted relative standard deviation below {SHARP:g}; the largest distance "
        f"from the truth is {max((c['away'] for c in sharp), default=float('nan')):.2g} of them.",
        "",
        "| predicted relative sd | distance from the truth, sd | rates with the largest shares |",
        "|---:|---:|---|",
    ]
    for c in result["combinations"]:
        lines.append(f"| {c['sd']:.2g} | {c['away']:.2g} | {', '.join(c['rates'])} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("-o", "--out", type=Path, default=Path("pollu"))
    parser.add_argument("--noise", type=float, default=1e-5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--search", action="store_true")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    result = study(given.out, given.noise, given.seed, given.search)
    (given.out / "pollu.json").write_text(json.dumps(result, indent=1))
    print(table(result))


if __name__ == "__main__":
    main()
