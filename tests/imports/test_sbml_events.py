"""Events of SBML as events of the language."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import UserError
from gbspec.imports.computing import decided
from gbspec.imports.formulas import Formula, both, compared, named, number
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


def delay(value: str) -> str:
    return f"<delay>{made.math(value)}</delay>"


def test_a_delayed_event_keeps_the_values_of_its_trigger(tmp_path: Path) -> None:
    """`e` sees y at its trigger; it is told so only where it matters."""
    events = made.happening(
        made.event("e", at("0.5"), {"x": "<ci>y</ci>"}, delay("<cn>1</cn>")),
        made.event("g", at("0.75"), {"y": "<cn>5</cn>"}),
        made.event("h", at("1"), {"w": "<cn>3</cn>"}, delay(made.apply("times", "2", "x")), persistent="false"),
    )
    text = text_of(tmp_path, made.sbml(FIXED, events))
    assert "event e when t >= 0.5 after 1 sampled: x = y" in text
    assert "event h when t >= 1 after 2*x transient: w = 3" in text
    found = solved(tmp_path, made.sbml(FIXED, events))
    assert found["x"] == pytest.approx([1, 1, 1])
    assert found["y"] == pytest.approx([1, 5, 5])


def growing(*events: str, rate: str = "0.5") -> str:
    """`A`, an amount of 1 in a compartment of size 1 that grows."""
    species = made.species("A", amount="1", boundary="true")
    rules = made.rules(C=f"<cn>{rate}</cn>")
    return made.sbml(made.compartments("1", constant="false"), species, rules, made.happening(*events))


def test_a_delayed_concentration_has_the_size_when_it_is_set(tmp_path: Path) -> None:
    """3 at t = 1.5, where the size is 1.75; the trigger's values are those of the concentration alone."""
    found = solved(tmp_path, growing(made.event("e", at("0.5"), {"A": "<cn>3</cn>"}, delay("<cn>1</cn>"))))
    assert found["A"][-1] == pytest.approx(3 * 1.75 / 2)


def test_a_concentration_after_its_compartment_has_the_new_size(tmp_path: Path) -> None:
    first = f"<priority>{made.math('<cn>2</cn>')}</priority>"
    events = (made.event("c", at("0.5"), {"C": "<cn>4</cn>"}, first), made.event("e", at("0.5"), {"A": "<cn>3</cn>"}))
    assert solved(tmp_path, growing(*events, rate="0"))["A"] == pytest.approx([1, 3, 3])


@pytest.mark.parametrize(
    "events",
    [
        [made.event("e", at("0.5"), {"A": made.apply("plus", "A", "1")}, delay("<cn>1</cn>"))],
        [
            made.event("c", at("0.5"), {"C": "<cn>4</cn>"}),
            made.event("e", at("0.5"), {"A": made.apply("plus", "A", "1")}),
        ],
    ],
)
def test_a_concentration_of_another_time_than_its_size_is_refused(tmp_path: Path, events: list[str]) -> None:
    with pytest.raises(UserError, match="the concentration `A` to a value of another time"):
        import_file(made.stored(tmp_path, growing(*events)), tmp_path / "out")


def test_events_at_one_time_see_the_values_before(tmp_path: Path) -> None:
    events = made.happening(
        made.event("e", at("0.5"), {"x": made.apply("plus", "y", "1")}),
        made.event("f", at("0.5"), {"y": made.apply("plus", "x", "2")}),
    )
    found = solved(tmp_path, made.sbml(FIXED, events))
    assert found["x"] == pytest.approx([1, 2, 2])
    assert found["y"] == pytest.approx([1, 3, 3])


def test_an_event_at_the_start_is_written_into_the_starts(tmp_path: Path) -> None:
    """By priority; `f` is cancelled by `e`, which makes its trigger false; `g` waits from the start."""
    high = f"<priority>{made.math('<cn>2</cn>')}</priority>"
    low = made.apply("lt", "x", "1.5")
    events = made.happening(
        made.event("f", low, {"w": "<cn>7</cn>"}, initial="false", persistent="false"),
        made.event("e", at("0"), {"x": made.apply("plus", "x", "1")}, high, initial="false"),
        made.event("g", at("0"), {"y": "<cn>4</cn>"}, delay("<cn>1.5</cn>"), initial="false"),
    )
    text = text_of(tmp_path, made.sbml(FIXED, events))
    assert "discrete x = 1 + 1" in text
    assert "event g when t >= 0 after 1.5 armed: y = 4" in text
    found = solved(tmp_path, made.sbml(FIXED, events))
    assert found["x"] == pytest.approx([2, 2, 2])
    assert found["y"] == pytest.approx([1, 1, 4])
    assert found["w"] == pytest.approx([0, 0, 0])


def test_a_priority_may_be_computed(tmp_path: Path) -> None:
    def ranked(name: str, rank: str, value: str) -> str:
        return made.event(name, at("0.5"), {"x": value}, f"<priority>{made.math(rank)}</priority>")

    events = made.happening(ranked("one", "<cn>1</cn>", "<cn>7</cn>"), ranked("two", "<ci>x</ci>", "<cn>5</cn>"))
    assert "priority x: x = 5" in text_of(tmp_path, made.sbml(FIXED, events))
    assert solved(tmp_path, made.sbml(FIXED, events))["x"] == pytest.approx([1, 5, 5])


def test_a_concentration_and_its_compartment_at_one_time(tmp_path: Path) -> None:
    """The amount is that by the size before, as the test suite has it."""
    event = made.event("e", at("0.5"), {"A": "<cn>3</cn>", "C": "<cn>4</cn>"})
    species = made.species("A", amount="4", boundary="true")
    found = solved(tmp_path, made.sbml(made.compartments("2", constant="false"), species, made.happening(event)))
    assert found["A"] == pytest.approx([2, 1.5, 1.5])


def test_a_random_order_is_refused(tmp_path: Path) -> None:
    rank = f"<priority>{made.math('<cn>1</cn>')}</priority>"
    events = [
        made.event(name, made.apply("lt", "x", TIME), {"x": TIME, name: "<cn>2</cn>"}, rank, persistent="false")
        for name in ("y", "w")
    ]
    with pytest.raises(UserError, match="random order"):
        import_file(made.stored(tmp_path, made.sbml(FIXED, made.happening(*events))), tmp_path / "out")


both_x = made.apply("gt", "x", "1.5")


@pytest.mark.parametrize(
    ("events", "reason"),
    [
        ([made.event("e", made.apply("gt", TIME, "0"), {"x": "<cn>2</cn>"})], "lies at its threshold"),
        ([made.event("e", made.apply("eq", TIME, "1"), {"x": "<cn>2</cn>"})], "a trigger with `==`"),
        ([made.event("e", made.apply("geq", made.apply("floor", TIME), "1"), {"x": "<cn>2</cn>"})], "with `floor`"),
        (
            [
                made.event("e", at("0"), {"x": "<cn>2</cn>"}, initial="false"),
                made.event("f", both_x, {"y": "<cn>3</cn>"}),
            ],
            "another event at the start can make it happen",
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


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        (compared(">=", named("p"), number(500)), False),
        (compared("<", named("p"), number(20)), True),
        (compared(">", named("p"), number(5)), None),
        (both([compared(">", named("p"), number(5)), compared(">", named("q"), number(3))]), False),
        (compared(">", named("p") * named("q"), number(-1)), True),
        (compared(">", named("unknown"), number(0)), None),
    ],
)
def test_a_trigger_at_the_start_is_judged_by_bounds(condition: Formula, expected: bool | None) -> None:
    assert decided(condition, {"q": 2.0}, {"p": (0.0, 10.0)}) is expected
