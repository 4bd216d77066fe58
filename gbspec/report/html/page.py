"""The page: sections inserted into the template, plotly's script inline, everything escaped."""

from __future__ import annotations

import json
import platform
import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import UserError
from gbspec.ir import Model
from gbspec.report import collect
from gbspec.report.description import Figure, Panel
from gbspec.report.figures import diagram, fit, functions, summary
from gbspec.report.html import charts, mathml, tables
from gbspec.report.kinds import KINDS, Kind
from gbspec.report.source import MissingError, Source
from gbspec.report.style import BEHIND, LEARNED, MUTED, TRUTH
from gbspec.report.text import likelihood_lines, number
from gbspec.report.verdict import Verdict, verdict
from gbspec.runs import Run
from gbspec.version import __version__

if TYPE_CHECKING:
    from markupsafe import Markup

    from gbspec.analysis import Diagram, Eigen, Validation

TEMPLATE = Path(__file__).with_name("report.html.j2")
PLOTLY = Path(__file__).with_name("plotly-basic.min.js")
"""The basic build of plotly.js 4.1.1 (npm: plotly.js-basic-dist-min), unchanged; its licence is beside it."""
DARK = {
    TRUTH: "#e4e6ea",
    LEARNED: "#6ea8ec",
    MUTED: "#9aa0a8",
    "rgba(31,95,168,": "rgba(110,168,236,",
    "rgba(238,240,243,": "rgba(58,63,70,",
    "rgba(242,244,247,": "rgba(44,48,54,",
    BEHIND: "#565b63",
}
"""Colours of charts by those that a dark page has instead."""
HARMLESS = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}
"""Characters that could end a script element, as JSON writes them within strings."""


@dataclass(frozen=True)
class Findings:
    """Further results for the report. `diagrams`: the run's and its truth's; None if not requested."""

    validation: Validation
    eigen: Eigen | None
    diagrams: tuple[Diagram, Diagram | None] | None = None


def page(fitted: collect.Fitted | None, run: Run, found: Findings) -> str:
    """The report as HTML. `fitted` is None if the training data are no longer available; sections that need them say
    so."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
                                     lstrip_blocks=True)  # fmt: skip
    environment.filters["math"] = mathml.inline
    environment.filters["words"] = words
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    store = _Charts()
    content = _content(fitted, run, found, store)
    return template.render(**content, charts=store.script(), dark=json.dumps(DARK),
                           plotly=PLOTLY.read_text(encoding="utf-8"))  # fmt: skip


def words(text: str) -> Markup:
    """A text, escaped, with what stands between backticks set as code."""
    from markupsafe import Markup, escape

    parts = text.split("`")
    if len(parts) % 2 == 0:  # a backtick without its partner
        return escape(text)
    return Markup("").join(Markup("<code>{}</code>").format(one) if k % 2 else one for k, one in enumerate(parts))


class _Charts:
    """Charts by number; the template contains placeholders, which the script fills."""

    def __init__(self) -> None:
        self.all: list[charts.Chart] = []

    def add(self, panel: Panel) -> int:
        """Stores the chart of a panel and returns its number."""
        return self.stack([panel])

    def stack(self, panels: Sequence[Panel]) -> int:
        """Stores one chart of panels below each other over one x axis, and returns its number."""
        self.all.append(charts.stack(panels))
        return len(self.all) - 1

    def groups(self, figure: Figure) -> list[Group]:
        """The panels of a figure, grouped by the headings of its rows; a column that shares its axis is one chart."""
        found: list[Group] = []
        for block in (block for row in figure.rows for block in row):
            if block.shared == "column":
                first = block.rows[0]
                column = [row.panels[0] for row in block.rows]
                number = self.stack([panel for panel in column if panel is not None])
                found.append(Group(first.heading, first.note, [number], block.chosen))
                continue
            for row in block.rows:
                numbers = [self.add(panel) for panel in row.panels if panel is not None]
                if row.heading or not found or block.chosen:
                    found.append(Group(row.heading, row.note, numbers, block.chosen))
                else:
                    found[-1].charts.extend(numbers)
        return found

    def script(self) -> str:
        """All charts as JSON that is safe in a script element."""
        text = json.dumps(self.all, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        for character, written in HARMLESS.items():
            text = text.replace(character, written)
        return text


@dataclass(frozen=True)
class Group:
    """Charts under a heading; `chosen`: the page shows one such group at a time."""

    heading: str
    note: str
    charts: list[int]
    chosen: bool


@dataclass(frozen=True)
class Section:
    """A section of the page: that of a figure with its charts, or of tables, which the template writes by the id.

    `missing` says why there are no charts.
    """

    id: str
    heading: str
    note: str = ""
    groups: tuple[Group, ...] = ()
    missing: str = ""


AFTER = {
    "functions": (Section("constants", "Constants"), Section("metrics", "Errors")),
    "history": (Section("bifurcation", "Bifurcations"),),
}
"""The sections of tables that follow a figure's."""
LAST = (Section("model", "Names"), Section("reproduce", "How to reproduce it"))


def _sections(source: Source, store: _Charts, empty: Collection[str] = frozenset()) -> list[Section]:
    """All sections in their order, without those of figures that have nothing to show, and the `empty` ones."""
    made = []
    for kind in KINDS:
        if kind.heading:
            made += [_section(kind, source, store), *AFTER.get(kind.id, ())]
    return [section for section in (*made, *LAST) if not section.missing and section.id not in empty]


def _section(kind: Kind, source: Source, store: _Charts) -> Section:
    """The section of a kind of figure, or why it is empty."""
    try:
        groups = tuple(store.groups(kind.build(source)))
    except MissingError as missing:
        return Section(kind.id, kind.heading, missing=missing.why)
    except UserError as error:
        return Section(kind.id, kind.heading, missing=error.diagnostics[0].message)
    return Section(kind.id, kind.heading, kind.note, groups)


@dataclass(frozen=True)
class Overview:
    """The first screen: the verdict, the fit of one trajectory and a learned function (charts, None: none)."""

    verdict: Verdict
    fit: int | None
    trajectory: str
    own: str
    function: int | None
    constants: tables.Table


def _overview(source: Source, found: Findings, store: _Charts, *, with_data: bool) -> Overview:
    run = source.run
    learned = source.functions if with_data else ()
    judged = verdict(run, found.validation, learned, with_data=with_data)
    constants = tables.few_constants(run)
    if not with_data:
        return Overview(judged, None, "", "", None, constants)
    index = summary.liveliest(source.fitted.data)
    (shown,) = collect.trajectory_fits(source.fitted, [index], hidden=True)
    time = run.model.time
    panels = [row.panels[0] for row in fit.block(shown, time.name, time.unit or "", page=True).rows]
    few = [panel for panel in panels if panel is not None][:MOST_PANELS]
    height = max(1.0, UPPER / len(few))
    chart = store.stack([replace(panel, height=height) for panel in few])
    drawn = next((function for function in learned if function.slices), None)
    function = None
    if drawn is not None:
        panel = functions.slice_panel(drawn.name, drawn.slices[0], drawn.unit)
        function = store.add(replace(panel, height=UPPER))
    return Overview(judged, chart, fit.heading(shown), shown.own, function, constants)


MOST_PANELS, UPPER = 4, 2.1
"""Panels of the trajectory on the first screen, and the height of its charts in inches."""


def _content(fitted: collect.Fitted | None, run: Run, found: Findings, store: _Charts) -> dict[str, object]:
    """The template's variables."""
    model = run.model
    source = Source(run, fitted.data if fitted else None, page=True, over=fitted, spectra=found.eigen)
    with_data = fitted is not None and bool(len(fitted.data))
    overview = _overview(source, found, store, with_data=with_data)
    shown = {
        "constants": tables.constants(run).rows or likelihood_lines(run),
        "metrics": tables.metrics(found.validation.to_json()),
        "bifurcation": found.diagrams,
        "model": tables.declared(model).rows,
    }
    return {
        "overview": overview,
        "model": model,
        "equations": _equations(model),
        "learned": _learned(model),
        "declared": tables.declared(model),
        "summary": _summary(run, found),
        "sections": _sections(source, store, {id for id, content in shown.items() if not content}),
        "total": len(fitted.data) if fitted else 0,
        "constants": tables.constants(run),
        "distributed": tables.distributed(run),
        "likelihood": likelihood_lines(run),
        "own_constants": tables.own_constants(run),
        "correlations": tables.correlations(run),
        "metrics": tables.metrics(found.validation.to_json()),
        "diagram": _diagram(found, store),
        "fast": found.eigen.fast_modes if found.eigen else (),
        "reproduce": _reproduce(run),
    }


def _equations(model: Model) -> list[tuple[str, str]]:
    """Headings and typeset blocks."""
    from markupsafe import Markup

    blocks = (
        ("Balances", mathml.balances(model), "="),
        ("Random disturbances", mathml.disturbances(model), "="),
        ("Algebraic equations", mathml.algebraic(model), "="),
        ("Rates and intermediates", mathml.intermediates(model), "="),
        ("Unknown functions", [mathml.postulate(model, unknown) for unknown in model.unknowns], "="),
        ("Measured", mathml.observations(model), "="),
        ("Starts", mathml.starts(model), "="),
        ("Before the start", mathml.histories(model), "="),
        ("Events", mathml.events(model), "⇒"),
    )
    # The printer has escaped all names, so that these need no further escaping.
    return [(heading, Markup(mathml.equations(pairs, sign))) for heading, pairs, sign in blocks if pairs]


def _learned(model: Model) -> str:
    """What the calligraphic N of the equations stands for; nothing without unknown functions."""
    splines = [name for network in model.networks if network.spline for name in network.outputs]
    others = [name for network in model.networks if not network.spline for name in network.outputs]
    if splines and others:
        return f"𝒩 learns what is not known: a spline in {', '.join(splines)}, a network in {', '.join(others)}."
    if splines or others:
        return f"𝒩 is the {'spline' if splines else 'network'} that learns what is not known."
    return ""


def _summary(run: Run, found: Findings) -> list[tuple[str, str]]:
    """The few numbers at the top of the page."""
    channels = found.validation.judged.values()
    cards = [
        (str(run.fit.data.trajectories), "trajectory" if run.fit.data.trajectories == 1 else "trajectories"),
        (str(run.fit.data.values), "measured values"),
        (str(len(run.numbers)), "members" if len(run.numbers) > 1 else "member"),
    ]
    if channels:
        largest = max(channels, key=lambda one: one.nrmse)
        of = "in the standard deviations of its logarithms" if largest.logarithms else "in its standard deviations"
        ahead = " one row ahead" if found.validation.ahead else ""
        cards.append((number(largest.nrmse, 3), f"largest error of a channel{ahead}, {of}"))
    truth = found.validation.truth
    if truth is not None:
        cards.append((number(truth.rhs.L2, 3), "L2 error of the right-hand side"))
    return cards


def _diagram(found: Findings, store: _Charts) -> dict[str, object] | None:
    """Charts and special points of the bifurcation diagram."""
    if found.diagrams is None:
        return None
    shown, truth = found.diagrams
    return {
        "parameter": shown.parameter,
        "groups": store.groups(diagram.figure(shown, truth=truth)),
        "text": str(shown),
        "truth": "" if truth is None else str(truth),
    }


def _reproduce(run: Run) -> dict[str, object]:
    """Commands, versions and fingerprints."""
    from gbspec.training import TrainOptions

    standard = TrainOptions().to_json()
    data = run.fit.data
    flags = []
    for name, value in run.fit.options.items():
        if name in standard and value != standard[name]:
            flag = name.replace("_", "-")
            flags += [f"--{'' if value else 'no-'}{flag}"] if isinstance(value, bool) else [f"--{flag}", str(value)]
    command = shlex.join(["gbspec", "train", "model.gb", data.path or "DATA", "-o", "RUN", *flags])
    versions = {"gbspec": run.fit.gbspec, **run.fit.versions}
    return {
        "command": command,
        "sha256": data.sha256 or "-",
        "path": data.path or "-",
        "versions": versions,
        "made": f"gbspec {__version__}, Python {platform.python_version()}",
        "text": run.model.text,
    }
