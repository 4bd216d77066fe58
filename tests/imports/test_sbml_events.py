"""Events of SBML as events of the language."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import UserError
from gbspec.operations.importing import import_file
from tests.imports import models as made
from tests.imports.test_sbml import DECAY, LAW, solved, text_of

TIME = '<csymbol encoding="text" definitionURL="http://www.sbml.org/sbml/symbols/time">time</csymbol>'
FIXED = made.parameters("false", x="1", y="1", w="0")


def at(time: str) -> str:
    return made.apply("geq", TIME, time)


def test_an_event_at_a_time_sets_a_parameter_and_a_species(tmp_path: Path) -> None:
    """From t = 0.5 on the rate is 0; both right sides see the values before."""
    parameters = made.parameters("false", k="0.5")
    event = made.event("stop", at("0.5"), {"k": "<cn>0</cn>", "A": made.apply("times", "k", "A")})
    model = made.sbml(
        made.compartments("2"), DECAY[1], parameters, made.reaction("decay", "A", "B", LAW), made.happening(event)
    )
    text = text_of(tmp_path, model)
    assert "discrete k = 0.5" in text
    assert "event stop when t >= 0.5: k = 0, A = k*A" in text
    found = solved(tmp_path, model)
    assert found["A"] == pytest.approx([2, *[np.exp(-0.25)] * 2], rel=1e-8)
    assert found["k"] == pytest.approx([0.5, 0, 0]), "what events change is a channel"


def test_a_compartment_that_an_event_changes_keeps_amounts(tmp_path: Path) -> None:
    species = made.species("A", amount="4", boundary="true")
    model = made.sbml(
        made.compartments("2", constant="false"),
        species,
        made.happening(made.event("grow", at("0.5"), {"C": "<cn>8</cn>"})),
    )
    found = solved(tmp_path, model)
    assert found["C"] == pytest.approx([2, 8, 8])
    assert found["A"] == pytest.approx([2, 0.5, 0.5])


def test_the_larger_priority_comes_first(tmp_path: Path) -> None:
    def ranked(name: str, rank: int, value: str) -> str:
        return made.event(name, at("0.5"), {"x": value}, f"<priority>{made.math(f'<cn>{rank}</cn>')}</priority>")

    events = made.happening(ranked("late", -1, "<cn>7</cn>"), ranked("soon", 3, "<cn>5</cn>"))
    assert solved(tmp_path, made.sbml(FIXED, events))["x"] == pytest.approx([1, 7, 7])


@pytest.mark.parametrize(
    ("events", "reason"),
    [
        ([made.event("e", at("0"), {"x": "<cn>2</cn>"}, initial="false")], "happen at the start"),
        ([made.event("e", made.apply("gt", TIME, "0"), {"x": "<cn>2</cn>"})], "lies at its threshold"),
        ([made.event("e", made.apply("eq", TIME, "1"), {"x": "<cn>2</cn>"})], "a trigger with `==`"),
        (
            [made.event("e", at("1"), {"x": "<cn>2</cn>"}, f"<priority>{made.math('<ci>y</ci>')}</priority>")],
            "a priority that is not a number",
        ),
        (
            [made.event("e", at("1"), {"x": "<ci>y</ci>"}), made.event("f", at("1"), {"y": "<ci>x</ci>"})],
            "it can happen together with another event",
        ),
        (
            [
                made.event("e", at("1"), {"w": "<cn>2</cn>"}),
                made.event("f", made.apply("gt", "w", "2"), {"y": "<cn>3</cn>"}),
            ],
            "another event sets a quantity to its threshold",
        ),
    ],
)
def test_events_with_other_solutions_are_refused(tmp_path: Path, events: list[str], reason: str) -> None:
    path = made.stored(tmp_path, made.sbml(FIXED, made.rules(w="<cn>0</cn>"), made.happening(*events)))
    with pytest.raises(UserError) as raised:
        import_file(path, tmp_path / "out")
    assert [reason in one.message for one in raised.value.diagnostics] == [True]


def test_events_at_different_times_may_use_each_other(tmp_path: Path) -> None:
    events = made.happening(
        made.event("e", at("0.5"), {"x": made.apply("plus", "y", "1")}),
        made.event("f", at("1.5"), {"y": made.apply("plus", "x", "1")}),
    )
    found = solved(tmp_path, made.sbml(FIXED, events))
    assert found["x"] == pytest.approx([1, 2, 2])
    assert found["y"] == pytest.approx([1, 1, 3])
