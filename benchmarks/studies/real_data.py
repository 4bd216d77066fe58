"""Published measurements: predictions of held-out data, as a table and figures.

    python -m benchmarks.studies.real_data DATA -o out [--members 1] [--effort normal]
    python -m benchmarks.studies.real_data DATA -o out --figures docs/figures

DATA is a folder with hare_lynx.csv, algae_rotifers.csv and theophylline.csv. Each part is a cross-validation (five
blocks of time; one subject at a time), stored in OUT and resumed by the same command; OUT/real_data.md has the errors
on the held-out data. `--figures` also fits all of the data and draws measurements, predictions and 90 % intervals.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.ir.model import Model
    from gbspec.studies.crossvalidation import CrossValidation
    from gbspec.training import TrainOptions

KNOWN = "hare_lynx with Lotka's and Volterra's term"
LOTKA_VOLTERRA = {
    "unknown eaten(hare) = 0.03*hare*nn by mlp(8, 8)": "learn b = 0.03 in [0.001, 1]\nlet eaten = b*hare",
    "eaten(hare)*lynx": "eaten*lynx",
}
DISTURBED_PELTS = {
    "observe hare\nobserve lynx": "learn sh = 0.2 in [0, 2]\nlearn sl = 0.2 in [0, 2]\n"
    "diffusion hare = sh*hare\ndiffusion lynx = sl*lynx\n"
    "observe hare noise lognormal(0.1)\nobserve lynx noise lognormal(0.1)"
}
DISTURBED_CHEMOSTAT = {
    "observe algae\nobserve rotifers": "learn sa = 0.1 in [0, 2]\nlearn sr = 0.1 in [0, 2]\nlearn se = 0.1 in [0, 2]\n"
    "diffusion algae = sa*algae\ndiffusion rotifers = sr*rotifers\ndiffusion edible = se*edible*(1 - edible)\n"
    "observe algae noise lognormal(0.1)\nobserve rotifers noise lognormal(0.1)",
    "initial algae learn\ninitial rotifers learn\n\n": "",
}


@dataclass(frozen=True)
class Part:
    """A cross-validation: a bundled model, possibly with parts of its text replaced, and the division of its data."""

    model: str
    over: str
    folds: int | None = None
    window: int | None = None
    replaced: Mapping[str, str] | None = None


PARTS = {
    "hare_lynx": Part("hare_lynx", "time", 5),
    KNOWN: Part("hare_lynx", "time", 5, replaced=LOTKA_VOLTERRA),
    "hare_lynx disturbed": Part("hare_lynx", "time", 5, replaced=DISTURBED_PELTS),
    f"{KNOWN} disturbed": Part("hare_lynx", "time", 5, replaced=LOTKA_VOLTERRA | DISTURBED_PELTS),
    "theophylline": Part("theophylline", "trajectories", window=5),
    "algae_rotifers": Part("algae_rotifers", "time", 5),
    "algae_rotifers disturbed": Part("algae_rotifers", "time", 5, replaced=DISTURBED_CHEMOSTAT),
}


def model_of(part: Part) -> Model:
    """The model of a part."""
    from gbspec import frontend
    from gbspec.diagnostics import Findings, Source

    text = frontend.resolve(part.model).read_text(encoding="utf-8")
    for old, new in (part.replaced or {}).items():
        if old not in text:
            raise SystemExit(f"{part.model}: the text has no `{old}`")
        text = text.replace(old, new)
    return frontend.load_model(part.model, Findings(), lambda _: Source(f"{part.model}.gb", text))


def judged(name: str, data: Path, out: Path, options: TrainOptions) -> CrossValidation:
    """The cross-validation of a part, computed or read from `out`."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import tables
    from gbspec.studies.crossvalidation import CrossOptions, crossvalidate
    from gbspec.training.progress import Silent

    part = PARTS[name]
    model = model_of(part)
    table = tables.read_data(data / f"{part.model}.csv", model, Findings())
    division = CrossOptions(part.folds, part.over, part.window)  # type: ignore[arg-type]  # a literal from a table
    return crossvalidate(model, table, out / re.sub(r"\W+", "_", name), options, division, lambda fold: Silent())


def rows_of(name: str, found: CrossValidation) -> list[str]:
    """A line of the table for each channel, and another one for predictions from the row before."""
    return [
        f"| {title} | {channel} | {one.n} | {one.nrmse:.3f} | {one.rmse_log:.3f} | {100 * one.covered:.0f} % |"
        for title, errors in ((name, found.total), (f"{name}, one row ahead", found.ahead))
        for channel, one in errors.items()
    ]


def draw(name: str, data: Path, out: Path, figures: Path, options: TrainOptions) -> None:
    """Fits all of the data of a part and draws measurements, the fit, and the 90 % interval of a measurement."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, fitting, models, tables
    from gbspec.training.progress import Silent

    model = model_of(PARTS[name])
    table = tables.read_data(data / f"{name}.csv", model, Findings())
    place = out / f"{name}_all"
    run = (
        models.open_run(place)
        if (place / "fit.json").is_file()
        else fitting.train(model, table, place, options, Silent())
    )
    seen = analysing.predict(run, table)
    shown = seen.variables if len(seen.items) == 1 else seen.channels
    panels = [(i, j) for i in range(len(seen.items)) for j in range(len(shown))]
    columns = min(len(panels), 4)
    lines = -(-len(panels) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(2.6 * columns, 2 * lines), squeeze=False, layout="constrained")
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    for ax, (i, j) in zip(axes.flat, panels, strict=False):
        item, variable = seen.items[i], seen.variables[j]
        ax.fill_between(item.times, item.low[:, j], item.high[:, j], color="C0", alpha=0.2, linewidth=0)
        ax.plot(item.times, item.mean[:, j], color="C0")
        if j < item.measured.shape[1]:
            ax.plot(item.times, item.measured[:, j], ".", color="black", markersize=4)
        ax.set_title(variable if len(seen.items) == 1 else f"{variable}, {item.label}", fontsize=8)
        ax.tick_params(labelsize=7)
    figures.mkdir(parents=True, exist_ok=True)
    figure.savefig(figures / f"{name}.png", dpi=80)
    plt.close(figure)


def main() -> None:
    """The command."""
    from gbspec.training.options import TrainOptions

    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies.real_data", description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--parts", default=",".join(PARTS), help="the cross-validations, separated by commas")
    parser.add_argument("--members", type=int, default=1)
    parser.add_argument("--effort", default="normal", choices=("low", "normal", "high"))
    parser.add_argument("--figures", type=Path)
    chosen = parser.parse_args()
    options = TrainOptions(members=chosen.members, effort=chosen.effort, threads=1, workers=1)
    lines = [
        f"`python -m benchmarks.studies.real_data --members {chosen.members} --effort {chosen.effort}`: errors on what"
        " was held out.",
        "",
        "| data and model | channel | held out | error / deviation | error of logarithms | in 90 % interval |",
        "|---|---|---|---|---|---|",
    ]
    for name in filter(None, chosen.parts.split(",")):
        lines += rows_of(name, judged(name, chosen.data, chosen.output, options))
        (chosen.output / "real_data.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(lines[-1], flush=True)
        if chosen.figures is not None and PARTS[name].replaced is None:
            draw(name, chosen.data, chosen.output, chosen.figures, options)


if __name__ == "__main__":
    main()
