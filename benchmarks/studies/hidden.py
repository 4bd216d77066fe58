"""Dense data with an unmeasured state: whether the defaults find dynamics, or only that the next value is this one.

    python -m benchmarks.studies.hidden -o hidden --seeds 3 --workers 2
    python -m benchmarks.studies.hidden -o hidden --table docs/studies/hidden.md

Bundled models without one of their channels, and `hidden_tanks.gb`: one trajectory of 1,000 even rows, without noise
and with 2 % of each channel's standard deviation, fitted with all defaults. `r2`: R² of whole solutions in the worst
channel; `naive`: that of the best predictor that knows no model; `loss_noise`: loss over that of the noise alone (with
noise); `fresh`: R² on two trajectories from other initial states and with other inputs, without noise, of which
`validate` estimates the initial states. A row is added to OUT/fits.csv as soon as its fit is done; the same command run
again continues with the missing fits.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

FIELDS = ("model", "noise", "seed", "r2", "naive", "loss_noise", "fresh", "seconds")
ROWS, FRESH = 1000, 2
NOISES = (0.0, 0.02)
Row = dict[str, str | float | int]


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


def one_fit(name: str, noise: float, seed: int) -> Row:
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
    return dict(zip(FIELDS, (name, noise, seed, own, naive, share, fresh, round(seconds)), strict=True))


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


def read(path: Path) -> list[Row]:
    """The rows of the finished fits, in the order of models, noises and seeds."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows: list[Row] = [dict(row) for row in csv.DictReader(file)]
    order = list(MODELS)
    return sorted(rows, key=lambda row: (order.index(str(row["model"])), float(row["noise"]), int(row["seed"])))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies.hidden", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("hidden"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", type=Path, help="write the table of the finished fits, without fitting")
    chosen = parser.parse_args()
    fits = chosen.output / "fits.csv"
    if chosen.table is None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        chosen.output.mkdir(parents=True, exist_ok=True)
        done = {(row["model"], float(row["noise"]), int(row["seed"])) for row in read(fits)}
        wanted = [(name, noise, seed) for seed in range(chosen.seeds) for noise in NOISES for name in reversed(MODELS)
                  if (name, noise, seed) not in done]  # fmt: skip
        with ProcessPoolExecutor(chosen.workers, mp_context=get_context("spawn")) as pool:
            for future in as_completed([pool.submit(one_fit, *each) for each in wanted]):
                new = not fits.is_file()
                with fits.open("a", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, FIELDS)
                    if new:
                        writer.writeheader()
                    writer.writerow(future.result())
    rows = read(fits)
    if not rows:
        raise SystemExit(f"{fits}: no finished fits yet")
    print(table(rows))
    if chosen.table is not None:
        chosen.table.write_text(table(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
