"""Kinds of figures: a new one is a module and an entry, drawn by matplotlib and plotly without another change."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import numpy as np
import plotly.graph_objects as go
import pytest

from gbspec import frontend
from gbspec.backends.module import load_module
from gbspec.cli.commands import plot
from gbspec.data.sampling import SimulateOptions
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings
from gbspec.operations import models, tables
from gbspec.report import files, kinds
from gbspec.report.description import (
    Axis,
    Band,
    Bars,
    Block,
    Figure,
    Heat,
    Line,
    Panel,
    Points,
    Row,
    Rug,
    Rule,
    Span,
    Text,
    pieces,
    single,
)
from gbspec.report.drawn import drawn
from gbspec.report.html import page
from gbspec.report.html.charts import chart
from gbspec.report.source import MissingError, Source
from gbspec.runs.record import DataRecord, FitRecord, MemberRecord
from gbspec.runs.store import Run

X = np.linspace(1.0, 2.0, 5)
EVERY_MARK = (
    Span("x", 1.0, 1.2, "ground"),
    Band(X, X - 0.1, X + 0.1, "members"),
    Line(X, X, "learned", hover=("here",) * 5),
    Line(X, X**2, "learned", dash="dashed"),
    Points(X, X, "measured"),
    Points(X, X, marker="up", hollow=True),
    Rule("y", 1.5, "90 %"),
    Rug(X),
    Heat(X, X, np.outer(X, X), 1.0, 4.0),
    Bars(X, np.arange(4.0)),
    Text(1.5, "above"),
)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    (tmp_path / "decay.gb").write_text(
        "model decay\nstate x in [0, 2] = 1\nunknown f(x) by mlp(4)\nx' = -f(x)\nobserve x\ninitial x = 1\n"
        "truth f(x) = 0.5*x\n"
    )
    model = frontend.load_model(tmp_path / "decay.gb", Findings())
    (tmp_path / "members" / "0").mkdir(parents=True)
    load_module(model).random(seed=0).save(tmp_path / "members" / "0" / "weights.safetensors")
    members = (MemberRecord(0, 1.0, {}, 0.0, ()),)
    fit = FitRecord("0", model.name, DataRecord("", "", 0, 0, 0), {}, {}, {}, {}, members, ())
    return Run(tmp_path, model, fit, (0,))


@pytest.fixture
def data(run: Run) -> Trajectories:
    return tables.simulate(models.reference(run.model), SimulateOptions(trajectories=2, span=2.0, keep_start=True))


def test_every_mark_is_drawn_by_both() -> None:
    panel = Panel(EVERY_MARK, Axis("x", "h"), Axis("y", log=True, range=(0.5, 5.0)), "all", legend=True)
    (axes, bar) = drawn(single(panel)).axes
    assert bar.get_xlabel() == ""
    labels = ["ground", "members", "learned", "measured", "90 %"]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == labels
    assert (axes.get_xlabel(), axes.get_yscale(), axes.get_ylim()) == ("x [h]", "log", (0.5, 5.0))
    made = chart(panel)
    json.dumps(made, allow_nan=False)
    checked = go.Figure(made)  # refuses what plotly does not know
    assert checked.layout.yaxis.range == (np.log10(0.5), np.log10(5.0))
    entries = [one.name for one in (*checked.data, *checked.layout.shapes) if one.showlegend]
    assert sorted(entries) == sorted(labels), "a label is in the legend once"
    assert [trace.type for trace in checked.data] == ["scatter"] * 6 + ["bar"]


def test_a_block_names_what_its_panels_share_once() -> None:
    panel = Panel((Line(X, X, "learned"), Line(X, X, "truth")), Axis("t"), Axis("x"))
    made = drawn(Figure(((Block((Row((panel, None), "first"), Row((panel, panel))), "below", "row"),),)))
    assert [axes.get_xlabel() for axes in made.axes if axes.axison] == ["", "t", "t"]
    assert made.axes[0].get_title(loc="left") == "first"
    assert [text.get_text() for text in made.legends[0].get_texts()] == ["learned", "truth"]


def test_a_curve_is_cut_where_its_stability_changes() -> None:
    found = pieces(X, X**2, (True, True, False, False, True))
    assert [(stable, x.tolist()) for stable, x, _ in found] == [
        (True, X[:3].tolist()),
        (False, X[2:].tolist()),
        (True, X[4:].tolist()),
    ]


def test_what_can_be_plotted_is_what_the_table_says(run: Run, data: Trajectories) -> None:
    assert get_args(plot.Kind) == kinds.names()
    assert all(kind.help in plot.HELP for kind in kinds.KINDS)
    with pytest.raises(ValueError, match="is no kind of figure"):
        files.draw("fits", run, data)


def test_a_new_kind_is_a_module_and_an_entry(run: Run, data: Trajectories, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module that would stand in `report/figures` and the entry of `KINDS`: two files, no renderer among them."""

    def build(source: Source) -> Figure:
        if source.page and len(source.fitted.data) > 5:
            raise MissingError("there are too many trajectories", "fit")
        counts = np.array([float(np.sum(item.counts)) for item in source.fitted.data.items])
        bars = Bars(np.arange(len(counts) + 1.0), counts)
        return single(Panel((bars,), Axis("values"), Axis("trajectory"), "how much was measured"))

    module: Any = ModuleType("scratch_figure")
    module.build = build
    monkeypatch.setitem(sys.modules, "scratch_figure", module)
    kind = kinds.Kind(
        "counts", "values by trajectory", "scratch_figure", "How much was measured", "Of each trajectory."
    )
    monkeypatch.setattr(kinds, "KINDS", (*kinds.KINDS, kind))
    monkeypatch.setattr(page, "KINDS", kinds.KINDS)

    assert "counts" in kinds.names()
    (axes,) = files.draw("counts", run, data).axes
    assert [bar.get_width() for bar in axes.patches] == [float(np.sum(item.counts)) for item in data.items]

    store = page._Charts()
    sections = page._sections(Source(run, data, page=True), store)
    (section,) = (one for one in sections if one.id == "counts")
    assert (section.heading, section.note) == ("How much was measured", "Of each trajectory.")
    (group,) = section.groups
    assert store.all[group.charts[0]]["data"][0]["type"] == "bar"
    many = Trajectories(data.items * 3, data.channels)
    assert "counts" not in [one.id for one in page._sections(Source(run, many, page=True), store)]


def test_every_kind_is_valid_on_the_page(run: Run, data: Trajectories) -> None:
    store = page._Charts()
    sections = {section.id: section for section in page._sections(Source(run, data, page=True), store)}
    for made in store.all:
        go.Figure(made)
    assert sections.keys().isdisjoint({"history", "starts", "phase"}), "there is nothing to show in these"
    assert sections["fit"].groups[1].chosen
    assert sections["functions"].groups[0].heading == "f of x"
