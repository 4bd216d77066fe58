"""Figures from plain arrays: what matplotlib draws of them, and that every form can be written."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis import InitialStates
from gbspec.analysis.prediction.start_comparison import InitialState
from gbspec.diagnostics import UserError
from gbspec.report import style
from gbspec.report.breaking import broken, cut
from gbspec.report.content import (
    ChannelFit,
    Given,
    History,
    LearnedConstant,
    LearnedFunction,
    Orbit,
    Plane,
    Residuals,
    Slice,
    TrajectoryFit,
)
from gbspec.report.description import Axis, Block, Figure, Line, Panel, Points, Row, single
from gbspec.report.drawn import drawn
from gbspec.report.figures import constants, fit, functions, history, initial_states, phase, residuals, summary
from gbspec.report.html.charts import stack

GRID = np.linspace(0.0, 1.0, 30)
TIMES = np.array([0.1, 0.5, 0.9])


def channel(name: str, *, truth: bool = True, members: int = 3) -> ChannelFit:
    curves = np.stack([np.sin(GRID) + 0.01 * k for k in range(members)])
    return ChannelFit(name, TIMES, np.sin(TIMES), GRID, curves, np.sin(GRID) if truth else None, "g/L")


def function(*, truth: bool = True, plane: bool = True) -> LearnedFunction:
    points = np.random.default_rng(0).uniform(size=(200, 2))
    values = points[:, 0] ** 2
    piece = Slice("a", GRID, GRID[None] ** 2, GRID**2 if truth else None, "b = 0.5", GRID, GRID[:5])
    surface = np.outer(np.ones(30), GRID)
    both = Plane("a", "b", GRID, GRID, surface, surface if truth else None, "") if plane else None
    return LearnedFunction("f", ("a", "b"), points, values[None], values if truth else None, (piece, piece), both)


def test_a_fit_has_a_column_for_each_trajectory_over_one_time_axis() -> None:
    trajectories = [
        TrajectoryFit("1", "D = 0.2", (channel("x"), channel("y"))),
        TrajectoryFit("2", "", (channel("x"),)),
    ]
    made = drawn(fit.figure(trajectories, "t", "h"))
    labels = [axes.get_ylabel() for axes in made.axes]
    assert labels == ["x [g/L]", "y [g/L]", "x [g/L]"]
    assert [axes.get_xlabel() for axes in made.axes] == ["", "t [h]", "t [h]"]
    assert made.axes[0].get_title(loc="left") == "trajectory 1, D = 0.2"
    assert made.axes[0].get_shared_x_axes().joined(made.axes[0], made.axes[1])
    assert not made.axes[0].get_shared_x_axes().joined(made.axes[0], made.axes[2])


def test_long_names_are_broken_where_their_panel_ends() -> None:
    """All that is written stays inside of the figure and does not run into the next panel."""
    name = "concentration_of_the_limiting_substrate"
    one = TrajectoryFit("A7", ", ".join(f"{name}_{k} = 3.25" for k in range(4)), (channel(name), channel("y")))
    slices = [replace(one, argument=name, label=f"{name} = 0.5, {name}_2 = 0.25") for one in function().slices]
    known = LearnedConstant(name, 0.5, (0.4, 0.6), (0.5,), 1.0, 0.6, None, "1/h")
    made = drawn(summary.figure(one, replace(function(), name=name, slices=tuple(slices)), [known], "t", "h"))
    made.draw_without_rendering()  # type: ignore[no-untyped-call]
    box = made.bbox
    for axes in made.axes:
        texts = [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]  # type: ignore[attr-defined]
        for text in (text for text in texts if text.get_text()):
            extent = text.get_window_extent()
            assert box.x0 <= extent.x0 and extent.x1 <= box.x1, text.get_text()
            assert box.y0 <= extent.y0 and extent.y1 <= box.y1, text.get_text()
            assert name in text.get_text().replace("\n", "") or name not in text.get_text()
    titles = [axes.get_title(loc="left") for axes in made.axes]
    assert titles[0].count("\n") and titles[2].count("\n"), titles
    assert broken("a short one", 3.0, 13.0) == "a short one" and broken("x" * 50, 1.0, 10.0).count("\n") == 4


def test_the_true_solution_is_said_to_begin_where_that_of_the_model_does() -> None:
    made = drawn(fit.figure([TrajectoryFit("1", "", (channel("x"),))], "t", "h"))
    said = [text.get_text() for part in made.subfigs or [made] for legend in part.legends for text in legend.texts]
    assert "truth, from the model's start" in said


def test_initial_states_are_drawn_over_the_labels_of_trajectories() -> None:
    state, off = np.array([1.0]), np.array([0.1])
    values = np.array([-0.25 + 0j])
    items = tuple(InitialState(label, 0.0, state, state, None, values, off, None) for label in ("P1", "P7", "Q2"))
    shown = initial_states.figure(InitialStates(("x",), items), {"x": "g/L"}, time="h")
    made = drawn(shown)
    (mode,) = (axes for axes in made.axes if axes.get_xlabel() == "trajectory")
    assert [text.get_text() for text in mode.get_xticklabels()] == ["P1", "P7", "Q2"]
    assert mode.get_title(loc="left") == "mode 1: decays in 4 h"
    (panel,) = (panel for row in shown.rows[0][0].rows for panel in row.panels if panel and panel.title)
    assert stack([panel])["layout"]["xaxis"]["ticktext"] == ["P1", "P7", "Q2"]
    many = Axis("trajectory", names=tuple(f"a long name of trajectory {k}" for k in range(100))).ticks(20)
    assert many == [(k, f"…{k}") for k in range(0, 100, 5)]


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (
            ("short", "control_group_of_2021", "treated_group_of_2021"),
            ["short", "control_group_o…", "treated_group_o…"],
        ),
        (("patient_number_01", "patient_number_12"), ["…01", "…12"]),
        (("patient_number_11", "patient_number_12"), ["…11", "…12"]),
        (("a", "patient_number_01", "patient_number_02"), ["a", "patient…umber_01", "patient…umber_02"]),
        (("the_same_name_of_both", "the_same_name_of_both"), ["the_same_name_o…"] * 2),
        ((), []),
    ],
)
def test_long_names_of_places_are_cut_where_they_agree(names: tuple[str, ...], shown: list[str]) -> None:
    assert cut(names, 16) == shown and all(len(name) <= 16 for name in shown)


def test_a_long_name_beside_upright_names_stays_inside_of_the_figure() -> None:
    labels = tuple(f"{k}_patient_of_{k}" for k in range(40))
    line = Line(np.arange(40.0), np.arange(40.0))
    name = "distance of the learned initial concentrations from those of the truth"
    made = drawn(single(Panel((line,), Axis("trajectory", names=labels), Axis(name))))
    made.draw_without_rendering()  # type: ignore[no-untyped-call]
    extent = made.axes[0].yaxis.label.get_window_extent()
    assert made.bbox.y0 <= extent.y0 and extent.y1 <= made.bbox.y1, made.axes[0].get_ylabel()


def test_titles_reach_over_panels_without_one_and_are_not_broken_at_an_equals_sign() -> None:
    title = "concentration: mean 0.02, variance 1.05, p = 0.012"
    panels = [Panel((Line(GRID, GRID),), Axis("x"), Axis("y"), said) for said in (title, " ", " ")]
    assert drawn(Figure(((Block((Row(tuple(panels)),)),),))).axes[0].get_title(loc="left") == title
    assert broken(title, 47.0, 1.0) == "concentration: mean 0.02, variance 1.05,\np = 0.012"
    assert broken("p = 0.012", 8.0, 1.0) == "p =\n0.012", "a line has no room for all of it"


def test_inputs_and_doses_are_drawn_below_what_is_measured() -> None:
    feed = Given("F", np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 1.0, 2.0, 2.0]), "L/h")
    dose = Given("dose into x", np.array([0.2, 0.6]), np.array([5.0, 7.0]), "mg", doses=True)
    one = TrajectoryFit("1", "", (channel("x"),), given=(feed, dose))
    made = drawn(fit.figure([one]))
    assert [axes.get_ylabel() for axes in made.axes] == ["x [g/L]", "F [L/h]", "dose into x [mg]"]
    np.testing.assert_array_equal(made.axes[1].lines[0].get_xdata(), feed.times)
    stems = np.column_stack(made.axes[2].lines[0].get_data())
    np.testing.assert_array_equal(stems[:2], [[0.2, 0.0], [0.2, 5.0]])
    page = stack([row.panels[0] for row in fit.block(one, page=True).rows if row.panels[0] is not None])
    assert {"xaxis", "yaxis", "yaxis2", "yaxis3"} <= page["layout"].keys()
    assert "xaxis2" not in page["layout"], "one time axis"
    bottoms = [page["layout"][f"yaxis{k}"]["domain"] for k in ("", 2, 3)]
    assert all(upper[0] > lower[1] for upper, lower in pairwise(bottoms))


def test_five_thousand_points_stay_readable() -> None:
    """They are small and behind the curve, and an excerpt shows single ones where the errors are largest."""
    times = np.linspace(0.0, 100.0, 5000)
    grid = np.linspace(0.0, 100.0, 8000)
    measured = np.sin(times) + np.where((times > 60) & (times < 62), 0.3, 0.0)
    shown = ChannelFit("x", times, measured, grid, np.sin(grid)[None])
    whole, part = drawn(fit.figure([TrajectoryFit("1", "", (shown,))])).axes
    points, curve = ({line.get_label(): line for line in whole.lines}[name] for name in ("measured", "model"))
    assert points.get_zorder() < curve.get_zorder()
    assert points.get_markersize() < 2
    low, high = part.get_xlim()
    assert 59 < low < 62 < high < 64
    assert {line.get_label(): line for line in part.lines}["measured"].get_markersize() == 3


def test_measurements_fit_and_truth_are_drawn_where_they_are() -> None:
    axes = drawn(fit.figure([TrajectoryFit("1", "", (channel("x"),))])).axes[0]
    lines = {line.get_label(): np.column_stack(line.get_data()) for line in axes.lines}
    assert set(lines) == {"model", "truth, from the model's start", "measured"}
    np.testing.assert_allclose(lines["model"][:, 1], np.sin(GRID) + 0.01)  # the mean of the members
    np.testing.assert_allclose(lines["measured"], np.column_stack([TIMES, np.sin(TIMES)]))
    assert len(axes.collections) == 1  # the range of the members is shaded


def test_without_a_truth_and_with_one_member_neither_is_drawn() -> None:
    axes = drawn(fit.figure([TrajectoryFit("1", "", (channel("x", truth=False, members=1),))])).axes[0]
    assert {line.get_label() for line in axes.lines} == {"model", "measured"}
    assert not axes.collections


@pytest.mark.parametrize(("truth", "plane", "panels"), [(True, True, 5), (False, True, 3), (False, False, 2)])
def test_functions_have_slices_planes_and_parity(truth: bool, plane: bool, panels: int) -> None:
    made = drawn(functions.figure([function(truth=truth, plane=plane)]))
    bars = 0 if not plane else 2 if truth else 1
    assert sum(axes.axison for axes in made.axes) == panels + bars
    assert {line.get_label() for line in made.axes[0].lines} >= {"learned", "postulate"}


def test_a_plane_has_the_band_s_half_width_beside_it() -> None:
    plain = function(truth=False)
    assert plain.plane is not None
    half = np.full((30, len(GRID)), 0.1)
    half[0] = np.nan  # far from the data
    panels = functions.planes("f", replace(plain.plane, half=half))
    assert [panel.title for panel in panels] == ["f, learned", "f, half the 90 % band"]
    made = drawn(functions.figure([replace(plain, plane=replace(plain.plane, half=half))]))
    assert sum(axes.axison for axes in made.axes) == 4 + 2


def test_parity_says_the_median_error() -> None:
    points = np.linspace(0, 1, 101)[:, None]
    shifted = LearnedFunction("f", ("a",), points, points[:, 0][None] + 0.01, points[:, 0], (), None)
    made = drawn(functions.figure([shifted]))
    assert made.axes[0].get_title(loc="left") == "median error 1 % of range"


def test_constants_each_on_an_axis_with_what_is_known() -> None:
    full = LearnedConstant("B", 11.1, (10.9, 11.2), (11.0, 11.2), start=5.0, truth=11.0)
    made = drawn(constants.figure([full, LearnedConstant("k", 2.0, None, (2.0,))]))
    assert made.axes[0].get_title(loc="left") == "B = 11.1, 0.91 % from the truth"
    assert {line.get_label() for line in made.axes[0].lines} == {"interval", "members", "learned", "truth", "start"}
    assert {line.get_label() for line in made.axes[1].lines} == {"learned"}


def test_history_has_the_loss_and_each_constant() -> None:
    seconds = np.arange(1.0, 7.0)
    member = History(0, ("warm",) * 2 + ("fit",) * 4, seconds, 10.0**-seconds, {"k": seconds})
    made = drawn(history.figure([member, member]))
    assert [axes.get_ylabel() for axes in made.axes] == ["loss", "k"]
    assert made.axes[0].get_yscale() == "log"
    assert [text.get_text() for text in made.axes[0].texts] == ["warm", "fit"]


def test_losses_of_stages_are_not_joined() -> None:
    stages = ("warm", "search", "search", "likelihood", "likelihood")
    member = History(0, stages, np.arange(5.0), np.array([1.0, 0.2, 0.1, 1.4, 1.3]), {})
    line, alone = history.figure([member]).rows[0][0].rows[0].panels[0].marks[-2:]
    assert isinstance(line, Line)
    np.testing.assert_array_equal(line.y, [1.0, np.nan, 0.2, 0.1, np.nan, 1.4, 1.3])
    assert line.hover == ("warm", "", "search", "search", "", "likelihood", "likelihood")
    assert isinstance(alone, Points)
    assert (alone.x.tolist(), alone.hover) == ([0.0], ("warm",))


def test_a_loss_that_falls_by_orders_of_magnitude_is_drawn_to_its_end() -> None:
    """Numbers on the page are rounded, but not to zero, which a logarithmic axis does not have."""
    (trace,) = [one for one in stack(history.figure([falling()]).rows[0][0].rows[0].panels)["data"] if "y" in one]
    assert trace["y"] == [75.0, 0.3, 1.74e-06]


def falling() -> History:
    return History(0, ("fit",) * 3, np.arange(3.0), np.array([75.0, 0.3, 1.74e-6]), {})


def test_a_gap_in_the_loss_does_not_break_the_history() -> None:
    loss = np.array([1.0, np.nan, 0.1])
    assert drawn(history.figure([History(0, ("fit",) * 3, np.arange(3.0), loss, {})])).axes


def test_residuals_have_three_panels_a_channel() -> None:
    channels = [Residuals(name, TIMES, TIMES, np.array([0.1, -0.1, 0.1])) for name in "xy"]
    made = drawn(residuals.figure(channels))
    assert len(made.axes) == 6
    assert made.axes[0].get_title(loc="left") == "x: 3 values, rms 0.1"


def test_phase_draws_each_orbit_and_labels_one() -> None:
    path = np.column_stack([GRID, GRID**2])
    made = drawn(
        phase.figure(
            [Orbit("1", path, path, path[:3]), Orbit("2", path, None, np.zeros((0, 2)))], Axis("x", "mol"), Axis("y")
        )
    )
    assert made.axes[0].get_xlabel() == "x [mol]"
    assert [text.get_text() for text in made.axes[0].get_legend().get_texts()] == [
        "model",
        "truth, from the model's start",
        "measured",
    ]


@pytest.mark.parametrize("count", [0, 2])
@pytest.mark.parametrize("with_function", [True, False])
def test_a_summary_of_whatever_there_is(with_function: bool, count: int) -> None:
    learned = [LearnedConstant(f"k{i}", 1.0, None, (1.0,)) for i in range(count)]
    made = drawn(
        summary.figure(TrajectoryFit("1", "", (channel("x"),)), function() if with_function else None, learned, "t")
    )
    assert len(made.axes) == 1 + 2 * with_function + count


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf", "PNG"])
def test_the_same_figure_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in "ab":
        style.save(drawn(fit.figure([TrajectoryFit("1", "", (channel("x"),))])), tmp_path / f"{name}.{suffix}")
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


@pytest.mark.parametrize(("name", "code"), [("f.jpeg", "GB812"), ("f", "GB812"), ("no/f.png", "GB805")])
def test_a_form_that_cannot_be_written(tmp_path: Path, name: str, code: str) -> None:
    with pytest.raises(UserError) as caught:
        style.save(drawn(fit.figure([TrajectoryFit("1", "", (channel("x"),))])), tmp_path / name)
    assert [d.code for d in caught.value.diagnostics] == [code]


def test_figures_leave_the_settings_of_matplotlib_alone() -> None:
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    drawn(fit.figure([TrajectoryFit("1", "", (channel("x"),))]))
    assert dict(mpl.rcParams) == before
