"""The page: sections put into the template, plotly's script put inline, everything escaped."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gbspec
from gbspec.ir.model import Model
from gbspec.report import collect
from gbspec.report.html import charts, gather, mathml
from gbspec.runs.store import Run

if TYPE_CHECKING:
    from gbspec.analysis.bifurcation.diagram import Diagram
    from gbspec.analysis.bifurcation.eigen import Eigen
    from gbspec.analysis.validation.validate import Validation

IN_PLANE = 8
"""Trajectories in the phase portrait: more would hide each other."""
TEMPLATE = Path(__file__).with_name("report.html.j2")
HARMLESS = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}
"""Characters that could end a script element, as JSON writes them within strings."""


@dataclass(frozen=True)
class Findings:
    """What was computed for the report beside the fit. `diagrams`: the run's and its truth's; None where not asked."""

    validation: Validation
    eigen: Eigen | None
    diagrams: tuple[Diagram, Diagram | None] | None = None


def page(fitted: collect.Fitted | None, run: Run, found: Findings) -> str:
    """The report as HTML. `fitted` is None where the training data are no longer there: what needs them says so."""
    import jinja2
    from plotly.offline import get_plotlyjs

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
                                     lstrip_blocks=True)  # fmt: skip
    environment.filters["math"] = mathml.inline
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    store = _Charts()
    content = _content(fitted, run, found, store.add)
    return template.render(**content, charts=store.script(), plotly=get_plotlyjs())


class _Charts:
    """Charts by number; the template asks for places, the script fills them."""

    def __init__(self) -> None:
        self.all: list[charts.Chart] = []

    def add(self, chart: charts.Chart) -> int:
        """Keeps a chart and gives its number."""
        self.all.append(chart)
        return len(self.all) - 1

    def script(self) -> str:
        """All charts as JSON that can stand in a script element."""
        text = json.dumps(self.all, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        for character, written in HARMLESS.items():
            text = text.replace(character, written)
        return text


Add = Callable[[charts.Chart], int]


def _content(fitted: collect.Fitted | None, run: Run, found: Findings, add: Add) -> dict[str, Any]:
    """The template's variables."""
    model = run.model

    def panels(given: Sequence[gather.Panel]) -> list[dict[str, Any]]:
        return [{"label": p.label, "note": p.note, "charts": [add(c) for c in p.charts]} for p in given]

    indices = gather.chosen(len(fitted.data)) if fitted else []
    past = collect.history(run)
    names = [s.name for s in model.states]
    validation = found.validation.to_json()
    return {
        "model": model,
        "equations": _equations(model),
        "declared": gather.declared_table(model),
        "summary": _summary(run, found),
        "warnings": found.validation.warnings_after(run.fit),
        "total": len(fitted.data) if fitted else 0,
        "fits": panels(gather.fits(fitted, indices)) if fitted else [],
        "residuals": [add(charts.residuals(r, model.time.name)) for r in collect.residuals(fitted)] if fitted else [],
        "history": [add(c) for c in charts.history(past)] if past else [],
        "functions": panels(gather.functions(fitted)) if fitted else [],
        "constants": gather.constants_table(run),
        "correlations": gather.correlations_table(run),
        "metrics": gather.metrics_tables(validation),
        "starts": [add(c) for c in gather.starts(fitted, indices)] if fitted else [],
        "parity": [add(c) for c in gather.parity(fitted)] if fitted else [],
        "diagram": _diagram(found, add),
        "eigen": add(charts.eigenvalues(found.eigen)) if found.eigen and found.eigen.points else None,
        "fast": found.eigen.fast_modes if found.eigen else (),
        "phase": add(
            charts.phase(collect.orbits(fitted, collect.spaced(len(fitted.data), IN_PLANE), (0, 1)), *names[:2])
        )
        if fitted and len(names) > 1
        else None,
        "reproduce": _reproduce(run),
    }


def _equations(model: Model) -> list[tuple[str, str]]:
    """Headings and typeset blocks."""
    from markupsafe import Markup

    blocks = (
        ("Balances", mathml.balances(model)),
        ("Rates and intermediates", mathml.intermediates(model)),
        ("Unknown functions", [mathml.postulate(model, unknown) for unknown in model.unknowns]),
        ("Measured", mathml.observations(model)),
        ("Starts", mathml.starts(model)),
    )
    # Every name in these was escaped by the printer, so they may stand as they are.
    return [(heading, Markup(mathml.equations(pairs))) for heading, pairs in blocks if pairs]


def _summary(run: Run, found: Findings) -> list[tuple[str, str]]:
    """A few numbers that are seen first."""
    from gbspec.report.text import number

    data = run.fit.get("data", {})
    errors = [one.nrmse for one in found.validation.channels.values()]
    cards = [
        (str(data.get("trajectories", "-")), "trajectories"),
        (str(data.get("values", "-")), "measured values"),
        (str(len(run.numbers)), "members" if len(run.numbers) > 1 else "member"),
    ]
    if errors:
        cards.append((number(max(errors), 3), "largest error of a channel, in its standard deviations"))
    truth = found.validation.truth
    if truth is not None:
        cards.append((number(truth.rhs.L2, 3), "L2 error of the right-hand side"))
    return cards


def _diagram(found: Findings, add: Add) -> dict[str, Any] | None:
    """Charts and special points of the bifurcation diagram."""
    if found.diagrams is None:
        return None
    shown, truth = found.diagrams
    return {
        "parameter": shown.parameter,
        "charts": [add(charts.diagram(shown, truth, i)) for i in range(len(shown.states))],
        "text": str(shown),
        "truth": "" if truth is None else str(truth),
    }


def _reproduce(run: Run) -> dict[str, Any]:
    """Commands, versions and fingerprints."""
    from gbspec.training.options import TrainOptions

    standard = TrainOptions().to_json()
    data, options = run.fit.get("data", {}), run.fit.get("options", {})
    flags = []
    for name, value in options.items():
        if name in standard and value != standard[name]:
            flag = name.replace("_", "-")
            flags.append(f"--{'' if value else 'no-'}{flag}" if isinstance(value, bool) else f"--{flag} {value}")
    command = " ".join(["gbspec train model.gb", str(data.get("path", "DATA")), "-o RUN", *flags])
    versions = {"gbspec": run.fit.get("gbspec", "-"), **run.fit.get("versions", {})}
    return {
        "command": command,
        "sha256": data.get("sha256", "-"),
        "path": data.get("path", "-"),
        "versions": versions,
        "made": f"gbspec {gbspec.__version__}, Python {platform.python_version()}",
        "text": run.model.text,
    }
