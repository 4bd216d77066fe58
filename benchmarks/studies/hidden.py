"""Dense data with an unmeasured state: whether the defaults find dynamics, or only that the next value is this one.

    python -m benchmarks.studies.hidden -o hidden --seeds 3 --workers 2
    python -m benchmarks.studies.hidden -o hidden --table docs/studies/hidden.md

Bundled models without one of their channels, and `hidden_tanks.gb`: one trajectory of 1,000 even rows, without noise
and with 2 % of each channel's standard deviation, fitted with all defaults. `r2`: R² of whole solutions in the worst
channel; `naive`: that of the best predictor that knows no model; `loss_noise`: loss over that of the noise alone (with
noise); `fresh`: R² on two trajectories from other initial states and with other inputs, without noise, of which
`validate` estimates the initial states. A row is added to OUT/sets.csv as soon as its fit is done; the same command run
again continues with the missing fits.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from .sets import Key, Row, Study, by_model

FIELDS = ("model", "noise", "seed", "r2", "naive", "loss_noise", "fresh", "seconds")
ROWS, FRESH = 1000, 2
NOISES = (0.0, 0.02)


@dataclass(frozen=True)
class Hidden:
    """A model, the channel that it loses (none: an own file, in which it is hidden already), and the duration."""

    source: str
    channel: str
    span: float

    @property
    def text(self) -> str:
        """The model without the channel."""
        from gbspec.data import shipped_model

        own = Path(__file__).with_name(f"{self.source}.gb")
        path = own if own.is_file() else shipped_model(self.source)
        assert path is not None, self.source
        lines = path.read_text(encoding="utf-8").splitlines()
        return "\n".join(line for line in lines if line != f"observe {self.channel}") + "\n"


MODELS = {
    "lotka_volterra without predators": Hidden("lotka_volterra", "predator", 60.0),
    "friction_oscillator without velocity": Hidden("friction_oscillator", "w", 100.0),
    "van_de_vusse without A": Hidden("van_de_vusse", "A", 100.0),
    "two tanks without the upper level": Hidden("hidden_tanks", "", 4000.0),
}


def one_fit(name: str, noise: float, seed: int) -> list[Row]:
    """Simulates a set and fits it."""
    from gbspec import frontend
    from gbspec.data import SimulateOptions
    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, fitting, models, tables
    from gbspec.training import TrainOptions

    hidden = MODELS[name]
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / f"{hidden.source}.gb"
        path.write_text(hidden.text, encoding="utf-8")
        model = frontend.load_model(str(path), Findings())
        step = hidden.span / ROWS

        def drawn(count: int, noise: float, seed: int) -> SimulateOptions:
            return SimulateOptions(count, hidden.span, step, sampling="regular", noise=noise, seed=seed)

        data = tables.simulate(models.reference(model), drawn(1, noise, seed))
        began = time.process_time()
        run = fitting.fit(model, data, Path(place) / "run", TrainOptions(threads=1, seed=seed))
        seconds = time.process_time() - began
        (member,) = run.fit.members
        found = analysing.validate(run, tables.simulate(models.reference(model), drawn(FRESH, 0.0, seed + 100)))
    channels = (member.channels or {}).values()
    fresh = min(errors.r2 for errors in found.channels.values())
    own, naive = (min(value for value in values if value is not None)
                  for values in ([c.r2 for c in channels], [c.naive for c in channels]))  # fmt: skip
    share = (member.loss or 0.0) / (0.5 * noise**2) if noise else 0.0
    return [dict(zip(FIELDS, (name, noise, seed, own, naive, share, fresh, round(seconds)), strict=True))]


def table(rows: Sequence[Row]) -> str:
    """The table in Markdown: a line for each model and noise, with the worst of its fits."""
    lines = [
        "One trajectory of 1,000 even rows, defaults, one member; the worst of the fits.",
        "",
        "| model | noise | fits | R² | naive R² | loss / noise | fresh R² | CPU s a fit |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, noise in dict.fromkeys((str(row["model"]), float(row["noise"])) for row in rows):
        own = [row for row in rows if (row["model"], float(row["noise"])) == (name, noise)]
        r2, fresh = (min(float(row[key]) for row in own) for key in ("r2", "fresh"))
        naive, share = (max(float(row[key]) for row in own) for key in ("naive", "loss_noise"))
        seconds = sum(float(row["seconds"]) for row in own) / len(own)
        shown = f"{share:.3g}" if noise else "-"
        lines.append(f"| {name} | {100 * noise:g} % | {len(own)} | {r2:.6f} | {naive:.3f} | {shown} | {fresh:.6f} | "
                     f"{seconds:.0f} |")  # fmt: skip
    return "\n".join(lines) + "\n"


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    return [(name, noise, seed) for seed in range(chosen.seeds) for noise in NOISES for name in reversed(MODELS)]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=5)


STUDY = Study("hidden", __doc__, FIELDS, one_fit, by_model, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
