"""The gallery's cases as cases.toml has them, and its page."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

HEAD = """# Gallery

Each case was executed as printed, in an empty folder, by `python -m benchmarks.gallery`; the numbers are those that
were measured. Models that are named without `.gb` are bundled: `gbspec new my_copy --from NAME` copies one to read and
to change. Most fits use `--effort low`, which takes a part of the time of the default. Processor time is that of all
commands of a case on {machine}. R² is that of whole solutions on the
data of the fit; the error of a function is its L2 difference from the truth that made the data, divided by the range of
the function.

Cases on published tables need a file that is not part of gbspec: [data_sources.md](data_sources.md) says who measured
it, where to get it, and what is known of its terms.
"""
MACHINE = "two cores of an AMD EPYC, which other work shared"


@dataclass(frozen=True)
class Case:
    """A case: `model` is a bundled one, `file` and `source` one that the reader saves; `table` is a published one."""

    title: str
    text: str
    commands: Sequence[str]
    figure: str
    model: str = ""
    file: str = ""
    source: str = ""
    table: str = ""
    squares: bool = False


def cases() -> dict[str, Case]:
    """The cases by name, in the order of the page."""
    found = tomllib.loads((Path(__file__).parent / "cases.toml").read_text(encoding="utf-8"))
    return {name: Case(**fields) for name, fields in found.items()}


def page(measured: Mapping[str, Any]) -> str:
    """The page of the cases that were executed."""
    shown = {name: case for name, case in cases().items() if name in measured}
    simulated = [name for name, case in shown.items() if not case.table]
    published = [name for name, case in shown.items() if case.table]
    parts = [HEAD.format(machine=MACHINE), "## Simulated measurements\n"]
    parts += [section(shown[name], measured[name]) for name in simulated]
    parts += ["## Published measurements\n"]
    parts += [section(shown[name], measured[name]) for name in published]
    return "\n".join(parts)


def section(case: Case, found: Mapping[str, Any]) -> str:
    """One case: text, model, commands, figure, numbers."""
    parts = [f"### {case.title}\n", case.text.strip() + "\n"]
    if case.model:
        (place,) = (ROOT / "models").glob(f"*/{case.model}.gb")
        parts.append(f"Model: [`{case.model}`](../{place.relative_to(ROOT).as_posix()})" + of_table(case) + "\n")
    else:
        parts += [f"Save the model as `{case.file}`" + of_table(case) + ":\n", f"```gb\n{case.source.strip()}\n```\n"]
    parts += ["```sh", *case.commands, "```\n", f"![{case.title}](gallery/{case.figure})\n", *numbers(found), ""]
    return "\n".join(parts)


def of_table(case: Case) -> str:
    """Which table a case needs."""
    return f"; table: `{case.table}` ([source](data_sources.md))" if case.table else ""


def numbers(found: Mapping[str, Any]) -> list[str]:
    """A table of what was measured."""
    rows = [
        ("measured values", f"{found['values']} in {plural(found['trajectories'], 'trajectory', 'trajectories')}"),
        ("processor time", f"{found['cpu']:.0f} s"),
        ("R²", fits(found["r2"])),
    ]
    if "squares" in found:
        rows.append(("sum of squares", f"{found['squares']:.5g}"))
    rows += [(f"`{name}`", constant(one, found["true"].get(name))) for name, one in found["constants"].items()]
    rows += [(f"error of `{name}`", f"{100 * error:.2g} %") for name, error in found["functions"].items()]
    return ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]


def plural(number: int, one: str, several: str) -> str:
    """A number of things."""
    return f"{number} {one if number == 1 else several}"


def fits(values: Mapping[str, float]) -> str:
    """R² of each channel, or the smallest of many."""
    if len(values) > 6:
        return f"{min(values.values()):.4f} or more ({len(values)} channels)"
    return ", ".join(f"{value:.4f} ({name})" for name, value in values.items())


def constant(one: Mapping[str, Any], error: float | None) -> str:
    """A constant with its interval and, where there is a truth, its relative error."""
    text = f"{one['value']:.4g}"
    if one["interval"]:
        low, high = one["interval"]
        text += f" ({low:.4g} to {high:.4g})"
    return text if error is None else f"{text}, {100 * error:.2g} % from the truth"
