"""The figure and the table of the README, from the results that the other commands wrote.

    python -m benchmarks.plot [--figure docs/benchmarks.png] [--readme README.md]

In the README only the text between two marks is replaced.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.accuracy import FITS, reached
from benchmarks.harness import markdown, parser, say
from benchmarks.step import quickest_first
from benchmarks.variants import VARIANTS

Result = Mapping[str, Any]

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- measured: make benchmarks -->", "<!-- end of what was measured -->"
LEVEL = 1e-3
"""The accuracy for which the README gives the time."""

DARK, LIGHT = "#1f4e79", "#9dc3e6"


def steps(axes: Axes, result: Result) -> None:
    """One bar per variant and precision, in multiples of the limit."""
    timings, limits = result["timings"], result["limit_ms"]
    ratios = {label: t["ms"] / limits[label.partition(" ")[2]] for label, t in timings.items()}
    names = quickest_first(timings)
    for offset, (dtype, color) in enumerate((("float32", DARK), ("float64", LIGHT))):
        bars = [(i + 0.4 * offset, ratios[f"{n} {dtype}"]) for i, n in enumerate(names) if f"{n} {dtype}" in ratios]
        drawn = axes.barh([at for at, _ in bars], [ratio for _, ratio in bars], 0.38, color=color, label=dtype)
        axes.bar_label(drawn, fmt="%.1f", fontsize=6, padding=2)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_yticks([i + 0.2 for i in range(len(names))], [plain(VARIANTS[n].title) for n in names], fontsize=7)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlim(right=2 * max(ratios.values()))
    axes.set_xlabel("time of a training step / time of its matrix products")
    axes.legend(fontsize=7)


def growth(axes: Axes, result: Result) -> None:
    """Time of a step over the number of trajectories."""
    cases = result["axes"]["trajectories"]
    for name in dict.fromkeys(name for case in cases for name in case["timings"]):
        at = [
            (case["size"]["trajectories"], case["timings"][name]["ms"] / 1e3)
            for case in cases
            if name in case["timings"]
        ]
        axes.loglog(*zip(*at, strict=True), marker="o", markersize=3, label=plain(VARIANTS[name].title))
    axes.set_xlabel("trajectories")
    axes.set_ylabel("seconds a step, float32")
    axes.legend(fontsize=7)


def accuracy(axes: Axes, result: Result) -> None:
    """Error of the learned right-hand side over processor time."""
    for name, curve in result["curves"].items():
        axes.semilogy([p["seconds"] for p in curve], [p["error"] for p in curve], label=plain(FITS[name][0]))
    axes.set_xlabel("processor seconds")
    axes.set_ylabel("error of the right-hand side (L2)")
    axes.set_ylim(bottom=axes.get_ylim()[0] / 20)  # room for the legend below the curves
    axes.legend(fontsize=7, loc="lower left")


PANELS = {"step": steps, "growth": growth, "accuracy": accuracy}


def plain(title: str) -> str:
    """A title without Markdown."""
    return title.replace("*", "").replace("`", "")


def figure(folder: Path) -> Figure:
    """One panel for each existing result."""
    found = {name: folder / f"{name}.json" for name in PANELS if (folder / f"{name}.json").is_file()}
    made = Figure(figsize=(4.6 * max(len(found), 1), 3.6), layout="constrained")
    for place, (name, path) in enumerate(found.items(), start=1):
        PANELS[name](made.add_subplot(1, len(found), place), json.loads(path.read_text()))
    return made


# ---------------------------------------------------------------------------------------------------------- the README
def summary(folder: Path, picture: str) -> str:
    """The README's section on the results in `folder`."""
    paragraphs = []
    if (folder / "step.json").is_file():
        paragraphs += _steps(json.loads((folder / "step.json").read_text()))
    if (folder / "accuracy.json").is_file():
        paragraphs.append(_accuracy(json.loads((folder / "accuracy.json").read_text())["curves"]))
    image = f"![time of a training step and its limit, its growth with the data, time to a given accuracy]({picture})"
    return "\n\n".join([*paragraphs, image])


def _steps(result: Result) -> list[str]:
    timings, limits, machine = result["timings"], result["limit_ms"], result["machine"]

    def cells(name: str, dtype: str) -> list[str]:
        ms = timings.get(f"{name} {dtype}", {}).get("ms")
        return ["", ""] if ms is None else [f"{ms:.1f}", f"{ms / limits[dtype]:.1f}"]

    rows = []
    for name in quickest_first(timings):
        memory = result["memory_mb"].get(name)
        used = "" if memory is None else f"{memory:.1f}"
        rows.append([VARIANTS[name].title, *cells(name, "float32"), *cells(name, "float64"), used])
    work = result["workload"]
    about = (
        f"One training step (loss and gradient over {work['trajectories']} trajectories of the reactor, "
        f"{work['measured']} measured values, {work['substeps']} Runge-Kutta steps) on {machine['processor']} "
        f"({machine['vector']}), medians of {result['rounds']} interleaved rounds. The limit is the time that the "
        "necessary matrix products take at the rate measured in the same rounds. The gradients of all variants were "
        "checked against each other first:"
    )
    header = ["", "f32 ms", "x limit", "f64 ms", "x limit", "peak MB"]
    return [about, markdown(header, rows)]


def _accuracy(curves: Mapping[str, Any]) -> str:
    texts = []
    for name, curve in curves.items():
        time, last = reached(curve, LEVEL), curve[-1]
        ended = f"not reached within {last['seconds']:.0f} s (final error {last['error']:.1e})"
        texts.append(f"{plain(FITS[name][0])}: {ended if time is None else f'{time:.0f} s'}")
    about = f"Processor time until the error of the learned right-hand side was at most {LEVEL:g}. "
    return about + "; ".join(texts) + "."


def fill(text: str, made: str) -> str:
    """A README with `made` between its marks. Raises ValueError if it has none."""
    pattern = re.compile(re.escape(BEGIN) + ".*?" + re.escape(END), re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"there is no {BEGIN} … {END}")
    return pattern.sub(lambda _: f"{BEGIN}\n{made}\n{END}", text, count=1)


def main() -> None:
    """Writes the figure and updates the README."""
    options = parser(__doc__)
    options.add_argument("--figure", type=Path, default=ROOT / "docs" / "benchmarks.png", metavar="FILE")
    options.add_argument("--readme", type=Path, default=ROOT / "README.md", metavar="FILE")
    chosen = options.parse_args()
    figure(chosen.output).savefig(chosen.figure, dpi=130)
    place = os.path.relpath(chosen.figure, chosen.readme.parent)
    chosen.readme.write_text(fill(chosen.readme.read_text(), summary(chosen.output, place)))
    say(f"wrote {chosen.figure} and filled {chosen.readme}")


if __name__ == "__main__":
    main()
