"""Dense data with an unmeasured state: whether the defaults find dynamics, or only that the next value is this one.

    python -m benchmarks.studies.hidden -o hidden --seeds 0 1 2 --workers 2
    python -m benchmarks.studies.hidden --rows benchmarks/studies/hidden_rows.csv --table docs/studies/hidden.md

Bundled models without one of their channels, and `hidden_tanks.gb`: 1,000 even rows (of one trajectory; of ten for the
reactor, which is soon at rest), without noise and with 2 % of each channel's standard deviation, fitted with all
defaults. `r2`: R² of whole solutions in the worst channel; `naive`: that of the best predictor that knows no model;
`loss_noise`: loss over that of the noise alone (with noise); `rhs`: the error of the right-hand side along the rows'
whole solutions, as the first and second rates of change of the measured states, which no transformation of unmeasured
ones alters, relative to their deviations (the worst); `fresh`: R² on two trajectories from other initial states and
with other inputs, without noise, of which `validate` estimates the initial states; `rhs_reference`, `reference`: the
same of a fit of whole solutions to the same rows that starts at the truth (`--start` with a run that was fitted to
exact rows of all states); `loss`, `loss_reference`: the mean of half squared residuals of whole solutions, in standard
deviations of the channels, of both fits. A row is added to the file of rows as soon as its fit is done; the same
command run again continues with the missing fits.
"""

from __future__ import annotations

import argparse
import atexit
import functools
import math
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .sets import Key, Row, Study, by_model

if TYPE_CHECKING:
    from gbspec.arrays import Array
    from gbspec.backends import Evaluator
    from gbspec.data import Trajectories
    from gbspec.ir import Model
    from gbspec.runs import MemberRecord
    from gbspec.training import TrainOptions

FIELDS = (
    "model",
    "noise",
    "seed",
    "r2",
    "naive",
    "loss_noise",
    "rhs",
    "rhs_reference",
    "fresh",
    "reference",
    "loss",
    "loss_reference",
    "seconds",
)
ROWS, FRESH = 1000, 2
NOISES = (0.0, 0.02)
WHOLE = "autoregressive"
"""The stage that fits whole solutions."""
LEAST = 1e-3
"""The smallest error, relative to the standard deviation, that is compared."""
WITHIN = 1.5
"""What is asked for: the error of a right-hand side is at most this many times that of a fit from the truth."""
EQUAL = 1.001
"""Up to this ratio two losses are those of equally good minima: half a unit of log likelihood of 1,000 values."""


@dataclass(frozen=True)
class Hidden:
    """A model, the channel that it loses (none: an own file, in which it is hidden already), and the duration."""

    source: str
    channel: str
    span: float
    trajectories: int = 1

    @property
    def complete(self) -> str:
        """The model with all states measured."""
        from gbspec.diagnostics import Findings
        from gbspec.frontend import load_model

        own = Path(__file__).with_name(f"{self.source}.gb")
        text = load_model(str(own) if own.is_file() else self.source, Findings()).text
        return text if self.channel else text + "observe upper\n"

    @property
    def text(self) -> str:
        """The model without the channel."""
        lines = self.complete.splitlines()
        return "\n".join(line for line in lines if line != f"observe {self.channel or 'upper'}") + "\n"


MODELS = {
    "lotka_volterra without predators": Hidden("lotka_volterra", "predator", 60.0),
    "friction_oscillator without velocity": Hidden("friction_oscillator", "w", 100.0),
    "van_de_vusse without A": Hidden("van_de_vusse", "A", 100.0),
    "urp_gb2 without the temperature": Hidden("urp_gb2", "x2", 10.0, 10),
    "two tanks without the upper level": Hidden("hidden_tanks", "", 4000.0),
}


def one_fit(name: str, noise: float, seed: int) -> list[Row]:
    """Simulates a set and fits it, with all defaults and from the truth."""
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.training import TrainOptions

    hidden = MODELS[name]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for file, text in (("all.gb", hidden.complete), ("hidden.gb", hidden.text)):
            (place / file).write_text(text, encoding="utf-8")
        everything, model = (load_model(str(place / file), Findings()) for file in ("all.gb", "hidden.gb"))
        data = drawn(model, hidden, hidden.trajectories, noise, seed)
        fresh = drawn(model, hidden, FRESH, 0.0, seed + 100)
        true = rates(everything, drawn(everything, hidden, hidden.trajectories, 0.0, seed), model)
        began = time.process_time()
        member, *found = fitted(model, data, fresh, true, place / "run", TrainOptions(threads=1, seed=seed))
        seconds = time.process_time() - began
        from_truth = TrainOptions(threads=1, seed=seed, start=str(fit_of_all(name)), stages=WHOLE)
        _, *reference = fitted(model, data, fresh, true, place / "reference", from_truth)
    channels = (member.channels or {}).values()
    own, naive = (min(value for value in values if value is not None)
                  for values in ([c.r2 for c in channels], [c.naive for c in channels]))  # fmt: skip
    share = (member.loss or 0.0) / (0.5 * noise**2) if noise else 0.0
    pairs = [value for pair in zip(found, reference, strict=True) for value in pair]
    values = (name, noise, seed, own, naive, share, *pairs, round(seconds))
    return [dict(zip(FIELDS, values, strict=True))]


def drawn(model: Model, hidden: Hidden, count: int, noise: float, seed: int) -> Trajectories:
    """Even rows of the truth."""
    from gbspec.data import SimulateOptions
    from gbspec.operations import models, tables

    step = hidden.span * hidden.trajectories / ROWS
    options = SimulateOptions(count, hidden.span, step, sampling="regular", noise=noise, seed=seed)
    return tables.simulate(models.reference(model), options)


@functools.cache
def fit_of_all(name: str) -> Path:
    """The directory of a run that was fitted to exact rows of all states, where others start."""
    from gbspec.diagnostics import Findings
    from gbspec.frontend import load_model
    from gbspec.operations import fitting
    from gbspec.training import TrainOptions

    hidden, place = MODELS[name], Path(tempfile.mkdtemp(prefix="gbspec-hidden-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    (place / "all.gb").write_text(hidden.complete, encoding="utf-8")
    model = load_model(str(place / "all.gb"), Findings())
    data = drawn(model, hidden, max(2, hidden.trajectories), 0.0, 0)
    fitting.fit(model, data, place / "truth", TrainOptions(threads=1))
    return place / "truth"


def fitted(
    model: Model, data: Trajectories, fresh: Trajectories, true: Array, place: Path, options: TrainOptions
) -> tuple[MemberRecord, float, float, float]:
    """A fit's member, the error of its right-hand side, its R² on fresh trajectories, of the worst channel, and its
    loss."""
    from gbspec.analysis import predictions
    from gbspec.backends import Evaluator
    from gbspec.operations import analysing, fitting

    run = fitting.fit(model, data, place, options)
    (member,) = run.fit.members
    evaluator = Evaluator(run.member(0))
    solved = [one.states for one in predictions(evaluator, run.model, data, run.fit)]
    off = rates_along(evaluator, data, solved, run.model) - true
    error = float(np.max(np.sqrt(np.mean(off**2, axis=0)) / np.std(true, axis=0)))
    fresh_r2 = min(errors.r2 for errors in analysing.validate(run, fresh).channels.values())
    return member, error, fresh_r2, loss_of(run.model, data, solved)


def loss_of(model: Model, data: Trajectories, solved: Sequence[Array]) -> float:
    """The mean of half squared differences between values and solutions, in standard deviations of the channels."""
    places = [channel.state for channel in model.channels]
    values = np.concatenate([item.values for item in data.items])
    off = (np.concatenate([states[:, places] for states in solved]) - values) / np.std(values, axis=0)
    return 0.5 * float(np.mean(off**2))


def rates(everything: Model, data: Trajectories, model: Model) -> Array:
    """The true rates of change [R, 2 C] of the states that `model` measures, at exact rows of all states."""
    from gbspec.analysis import truth_evaluator

    places = [[channel.state for channel in everything.channels].index(i) for i in range(len(everything.states))]
    return rates_along(truth_evaluator(everything), data, [item.values[:, places] for item in data.items], model)


def rates_along(evaluator: Evaluator, data: Trajectories, states: Sequence[Array], model: Model) -> Array:
    """First and second rates of change [R, 2 C] of the states that `model` measures, at trajectories' states [R, n]."""
    from gbspec.analysis import input_values

    measured = np.array([channel.state for channel in model.channels], dtype=np.intp)
    found = []
    for item, at in zip(data.items, states, strict=True):
        inputs = input_values(model, item, item.times)
        first = evaluator.rhs_many(item.times, at, item.condition, inputs)[:, measured]
        found.append(np.hstack([first, np.gradient(first, item.times, axis=0)]))
    return np.concatenate(found)


def table(rows: Sequence[Row]) -> str:
    """The table in Markdown: a line for each model and noise, with the worst of its fits, and what they add up to."""
    lines = [
        "1,000 even rows, defaults, one member; the worst of the fits. `error / from truth`: the error on fresh",
        f"trajectories over that of a fit that starts at the truth, both at least {LEAST:g}: the median and the worst.",
        "`rhs`: the worst error of the right-hand side along the rows' solutions; beside it, over that from the truth,",
        f"the number of fits in which that is at most {WITHIN:g}, and the others, each with its loss over that from",
        "the truth. `loss / from truth`: the worst of all fits.",
        "",
        "| model | noise | fits | R² | naive R² | loss / noise | rhs | rhs / from truth | within "
        "| others (seed: rhs, loss) | loss / from truth | fresh R² | error / from truth | CPU s a fit |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---|---:|---:|---:|---:|",
    ]
    for name, noise in dict.fromkeys((str(row["model"]), float(row["noise"])) for row in rows):
        own = [row for row in rows if (row["model"], float(row["noise"])) == (name, noise)]
        r2, fresh = (min(float(row[key]) for row in own) for key in ("r2", "fresh"))
        naive, share = (max(float(row[key]) for row in own) for key in ("naive", "loss_noise"))
        ratios = [_error(row["fresh"]) / _error(row["reference"]) for row in own]
        along = [_along(row) for row in own]
        rhs = max(float(row["rhs"]) for row in own)
        seconds = sum(float(row["seconds"]) for row in own) / len(own)
        shown = f"{share:.3g}" if noise else "-"
        others = [f"{row['seed']}: {_along(row):.2f}, {_loss(row):.4g}" for row in own if _along(row) > WITHIN]
        within = f"{len(own) - len(others)} | {'; '.join(others) or '-'} | {max(_loss(row) for row in own):.3g}"
        lines.append(f"| {name} | {100 * noise:g} % | {len(own)} | {r2:.6f} | {naive:.3f} | {shown} | {rhs:.2g} | "
                     f"{statistics.median(along):.2f}, {max(along):.2f} | {within} | {_short(fresh)} | "
                     f"{statistics.median(ratios):.2f}, {_short(max(ratios), 2)} | {seconds:.0f} |")  # fmt: skip
    return "\n".join([*lines, "", _verdict(rows)]) + "\n"


def _verdict(rows: Sequence[Row]) -> str:
    """How many fits are as near to the truth as asked, and how good the minima of the others are."""
    others = [row for row in rows if _along(row) > WITHIN]
    near = f"{len(rows) - len(others)} of {len(rows)} fits have an error of the right-hand side of at most {WITHIN:g} "
    said = [f"{near}times that of the fit from the truth."]
    if others:
        equal = sum(_loss(row) <= EQUAL for row in others)
        said.append(
            f"Of the other {len(others)}, {equal} end with at most {EQUAL:g} times the loss of the fit from the truth: "
            "as good a minimum, so that the estimates differ and the search has not failed."
        )
    return "\n".join(said)


def _along(row: Row) -> float:
    """The error of the right-hand side over that of the fit from the truth."""
    return max(LEAST, float(row["rhs"])) / max(LEAST, float(row["rhs_reference"]))


def _loss(row: Row) -> float:
    """The loss over that of the fit from the truth."""
    return float(row["loss"]) / float(row["loss_reference"])


def _short(number: float, decimals: int = 6) -> str:
    """A number with some decimals; where a solution has blown up its order of magnitude."""
    return f"{number:.{decimals}f}" if abs(number) < 1e3 else f"{number:.0e}"


def _error(r2: str | float) -> float:
    """The error relative to the standard deviation."""
    return max(LEAST, math.sqrt(1 - float(r2)))


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    names = [name for name in reversed(MODELS) if any(part in name for part in chosen.models)]
    return [(name, noise, seed) for seed in chosen.seeds for noise in chosen.noises for name in names]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(5)))
    parser.add_argument("--models", nargs="+", default=[""], help="parts of names of models (default: all)")
    parser.add_argument("--noises", nargs="+", type=float, default=list(NOISES))


STUDY = Study("hidden", __doc__, FIELDS, one_fit, by_model, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
