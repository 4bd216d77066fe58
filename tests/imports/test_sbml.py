"""import of SBML: small models with closed forms, and cases of the SBML test suite."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.diagnostics import UserError
from gbspec.operations.importing import import_file
from tests.imports import models as made
from tests.imports.suites import suite

pytest.importorskip("libsbml", reason="SBML needs the extra `sbml`")


def solved(folder: Path, text: str, span: float = 2.0) -> dict[str, np.ndarray]:
    """The channels at the start, the middle and the end."""
    found = import_file(made.stored(folder, text), folder / "out")
    model = gbspec.load(found.model)
    (item,) = model.simulate(trajectories=1, span=span, dt=span / 2, sampling="regular", keep_start=True).items
    return {c.column: item.values[:, i] for i, c in enumerate(model.model.channels)}


def text_of(folder: Path, text: str) -> str:
    return Path(import_file(made.stored(folder, text), folder / "out").model).read_text(encoding="utf-8")


DECAY = (made.parameters(k="0.5"), made.species("A", "B", amount="4"))
LAW = made.apply("times", "C", "k", "A")


def test_a_reaction_becomes_a_process_of_concentrations(tmp_path: Path) -> None:
    model = made.sbml(made.compartments("2"), *reversed(DECAY), made.reaction("decay", "A", "B", LAW))
    text = text_of(tmp_path, model)
    assert "process decay: A -> B rate k*A" in text, "the compartment is a factor of the kinetic law"
    assert "initial A = 2" in text, "an amount of 4 in a compartment of 2"
    found = solved(tmp_path, model)
    assert found["A"] == pytest.approx(2 * np.exp([0, -0.5, -1.0]), rel=1e-8)
    assert found["A"] + found["B"] == pytest.approx([4.0, 4.0, 4.0])


def test_amounts_are_conserved_where_the_compartment_grows(tmp_path: Path) -> None:
    """dC/dt = 0.5 C: the amount of A decays at rate k, and its concentration is diluted besides."""
    model = made.sbml(
        made.compartments("1", constant="false"),
        *reversed(DECAY),
        made.rules(C=made.apply("times", "0.5", "C")),
        made.reaction("decay", "A", "B", LAW),
    )
    found = solved(tmp_path, model)
    assert found["C"] == pytest.approx(np.exp([0, 0.5, 1.0]), rel=1e-8)
    assert found["A"] == pytest.approx(4 * np.exp([0, -1.0, -2.0]), rel=1e-8)


def test_conversion_factors_and_boundary_species(tmp_path: Path) -> None:
    """A is held, B grows by 3 for each turn."""
    species = made.species("A", amount="2", boundary="true") + made.species(
        "B", amount="0", more=' conversionFactor="f"'
    )
    model = made.sbml(
        made.compartments(),
        species.replace("</listOfSpecies><listOfSpecies>", ""),
        made.parameters(k="0.5", f="3"),
        made.reaction("make", "A", "B", made.apply("times", "k", "A")),
    )
    found = solved(tmp_path, model)
    assert found["A"] == pytest.approx([2, 2, 2])
    assert found["B"] == pytest.approx([0, 3, 6])


def test_names_that_the_language_reserves_keep_their_columns(tmp_path: Path) -> None:
    model = made.sbml(
        made.parameters("false", state="1", exp="2", t="3"),
        made.rules(state="<ci>exp</ci>", exp="<ci>t</ci>", t="<cn>0</cn>"),
    )
    found = solved(tmp_path, model)
    assert found["exp"] == pytest.approx([2, 5, 8])
    assert found["state"] == pytest.approx([1, 4.5, 11])


def test_a_model_without_balances_gets_a_clock(tmp_path: Path) -> None:
    body = made.apply(
        "times", '<csymbol encoding="text" definitionURL="http://www.sbml.org/sbml/symbols/time">t</csymbol>', "2"
    )
    model = made.sbml(
        made.parameters("false", x="1"),
        f'<listOfRules><assignmentRule variable="x">{made.math(body)}</assignmentRule></listOfRules>',
    )
    found = import_file(made.stored(tmp_path, model), tmp_path / "out")
    assert any("clock" in one.reason for one in found.left_out)
    assert solved(tmp_path, model)["x"] == pytest.approx([0, 2, 4])


def test_initial_assignments_are_inlined_into_constants(tmp_path: Path) -> None:
    """q = 2 y(0), where y starts at p + 1."""
    assignments = "".join(
        f'<initialAssignment symbol="{name}">{made.math(body)}</initialAssignment>'
        for name, body in (("y", made.apply("plus", "p", "1")), ("q", made.apply("times", "2", "y")))
    )
    model = made.sbml(
        made.parameters("false", p="3", y="0", q="0"),
        f"<listOfInitialAssignments>{assignments}</listOfInitialAssignments>",
        made.rules(y=made.apply("minus", "q")),
    )
    found = solved(tmp_path, model)
    assert found["q"] == pytest.approx([8, 8, 8])
    assert found["y"] == pytest.approx([4, -4, -12])


def test_descriptions_and_units_are_kept_where_they_agree(tmp_path: Path) -> None:
    units = (
        '<listOfUnitDefinitions><unitDefinition id="rate"><listOfUnits>'
        '<unit kind="second" exponent="-1" scale="0" multiplier="1"/>'
        "</listOfUnits></unitDefinition></listOfUnitDefinitions>"
    )
    model = made.sbml(
        units,
        '<listOfParameters><parameter id="k" name="a rate" units="rate" value="2" constant="true"/>'
        '<parameter id="y" units="metre" value="3" constant="false"/></listOfParameters>',
        made.rules(y=made.apply("minus", "<apply><times/><ci>k</ci><ci>y</ci></apply>")),
        attributes=' timeUnits="second"',
    )
    text = text_of(tmp_path, model)
    assert "time t : s from 0" in text
    assert 'const k : 1/s = 2 "a rate"' in text
    assert "state y : m" in text


def test_units_that_disagree_are_left_out_and_listed(tmp_path: Path) -> None:
    model = made.sbml(
        '<listOfParameters><parameter id="y" units="metre" value="3" constant="false"/>'
        '<parameter id="z" units="second" value="3" constant="false"/></listOfParameters>',
        made.rules(y="<ci>z</ci>", z=made.apply("plus", "y", "z")),
        attributes=' timeUnits="second"',
    )
    found = import_file(made.stored(tmp_path, model), tmp_path / "out")
    assert [one.element for one in found.left_out] == ["units"]
    assert ": m" not in Path(found.model).read_text()


def test_functions_that_round(tmp_path: Path) -> None:
    """`quotient` rounds towards 0 and `rem` has the sign of the first argument, as MathML says."""
    assigned = {name: made.apply(name, "x") for name in ("floor", "ceiling")}
    assigned |= {name: made.apply(name, "x", "two") for name in ("quotient", "rem")}
    assigned |= {"whole": made.apply("quotient", "7", "2"), "left": made.apply("rem", "7", "2")}
    assigned["six"] = made.apply("factorial", made.apply("ceiling", made.apply("plus", "two", "0.5")))
    rules = "".join(f'<assignmentRule variable="{k}_">{made.math(v)}</assignmentRule>' for k, v in assigned.items())
    rules += f'<rateRule variable="x">{made.math("<cn>-4.9</cn>")}</rateRule>'
    free = made.parameters("false", x="5", **{f"{name}_": "0" for name in assigned})
    free = free.replace("</listOfParameters>", '<parameter id="two" value="2" constant="true"/></listOfParameters>')
    found = solved(tmp_path, made.sbml(free, f"<listOfRules>{rules}</listOfRules>"))
    assert found["x"] == pytest.approx([5.0, 0.1, -4.8])
    assert found["floor_"].tolist() == [5, 0, -5]
    assert found["ceiling_"].tolist() == [5, 1, -4]
    assert found["quotient_"].tolist() == [2, 0, -2]
    assert found["rem_"] == pytest.approx([1.0, 0.1, -0.8])
    assert (found["whole_"].tolist(), found["left_"].tolist(), found["six_"].tolist()) == ([3] * 3, [1] * 3, [6] * 3)


def pieces(*conditions: tuple[str, str, str]) -> str:
    """A `piecewise` without `otherwise`, whose pieces have the values 1, 2, ..."""
    each = (f"<piece><cn>{i}</cn>{made.apply(*one)}</piece>" for i, one in enumerate(conditions, 1))
    return f"<piecewise>{''.join(each)}</piecewise>"


INFINITE = "<infinity/>"


@pytest.mark.parametrize(
    ("conditions", "wanted"),
    [
        ([("gt", "x", "0"), ("leq", "x", "0")], [1, 2]),
        ([("gt", "x", "y"), ("geq", "y", "x")], [1, 2]),
        ([("lt", "x", "0"), ("geq", "2", "x"), ("gt", "x", "2")], [2, 1]),
        ([("lt", "x", INFINITE)], [1, 1]),
        ([("geq", "x", INFINITE), ("neq", "x", INFINITE)], [2, 2]),
        ([("gt", "x", "0"), ("lt", "x", "0")], None),
        ([("gt", "x", "0"), ("leq", "x", "1"), ("leq", "y", "0")], None),
        ([("lt", "x", "0"), ("geq", "x", "1")], None),
    ],
)
def test_pieces_without_otherwise(
    tmp_path: Path, conditions: list[tuple[str, str, str]], wanted: list[float] | None
) -> None:
    """They are imported where the conditions leave out nothing."""
    rate = f'<rateRule variable="x">{made.math("<cn>-1</cn>")}</rateRule>'
    rules = f'{rate}<assignmentRule variable="z">{made.math(pieces(*conditions))}</assignmentRule>'
    text = made.sbml(made.parameters("false", x="1", y="0.25", z="0"), f"<listOfRules>{rules}</listOfRules>")
    if wanted is not None:
        found = solved(tmp_path, text)["z"]
        assert [found[0], found[-1]] == wanted
        return
    with pytest.raises(UserError, match="without `otherwise`"):
        import_file(made.stored(tmp_path, text), tmp_path / "out")


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        ("<listOfRules><algebraicRule>{x}</algebraicRule></listOfRules>", "algebraic rules are not offered yet"),
        ('<listOfRules><rateRule variable="x">{delay}</rateRule></listOfRules>', "a delay is not offered yet"),
        ('<listOfRules><rateRule variable="x">{factorial}</rateRule></listOfRules>', "the factorial of a quantity"),
        ('<listOfRules><rateRule variable="x">{unknown}</rateRule></listOfRules>', "nothing declares it"),
    ],
)
def test_what_has_no_form_is_refused_with_its_place(tmp_path: Path, part: str, reason: str) -> None:
    delay = '<csymbol encoding="text" definitionURL="http://www.sbml.org/sbml/symbols/delay">delay</csymbol>'
    part = part.format(
        x=made.math("<ci>x</ci>"),
        delay=made.math(f"<apply>{delay}<ci>x</ci><cn>1</cn></apply>"),
        factorial=made.math(made.apply("factorial", "x")),
        unknown=made.math("<ci>nobody</ci>"),
    )
    path = made.stored(tmp_path, made.sbml(made.parameters("false", x="1"), part))
    with pytest.raises(UserError) as raised:
        import_file(path, tmp_path / "out")
    assert any(reason in one.message for one in raised.value.diagnostics)
    assert {one.code for one in raised.value.diagnostics} <= {"GB895"}
    assert not (tmp_path / "out").exists()


def test_all_reasons_are_given_at_once(tmp_path: Path) -> None:
    time = '<csymbol encoding="text" definitionURL="http://www.sbml.org/sbml/symbols/time">time</csymbol>'
    events = (made.event(f"e{i}", made.apply("eq", time, "1"), {"x": "<cn>2</cn>"}) for i in range(3))
    path = made.stored(tmp_path, made.sbml(made.parameters("false", x="1"), made.happening(*events)))
    with pytest.raises(UserError) as raised:
        import_file(path, tmp_path / "out")
    assert len(raised.value.diagnostics) == 3


@pytest.mark.parametrize(
    "case", ["00001", "00051", "00069", "00197", "00901", "01113", "01116", "01277", "01485", "01562"]
)
def test_cases_of_the_suite(tmp_path: Path, case: str) -> None:
    """Amounts, a changing compartment, Level 2, `ceiling`, conversion factors, constants alone, a `piecewise` without
    `otherwise`, `quotient`, rare functions."""
    from benchmarks.studies.sbml import judged

    assert judged(suite("sbml") / case).end == "passed"


def test_the_page_of_the_study_counts_outcomes() -> None:
    from benchmarks.studies.sbml import Outcome, page

    text = page([Outcome("1", "passed"), Outcome("2", "refused", ("event e: not offered yet",))], 1.0)
    assert "| every value within the suite's tolerance | 1 |" in text
    assert "| not offered yet | 1 |" in text


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('level="3" version="2"', 'level="3" version="7"', "its root is not that of SBML"),
        ("level3/version2/core", "level9/core", "its root is not that of SBML"),
        ('value="1"', 'value="INF"', "not finite"),
        ("<ci>x</ci>", "<apply><divide/><ci>x</ci></apply>", "number of arguments"),
    ],
)
def test_what_other_readers_end_on_is_refused(tmp_path: Path, old: str, new: str, reason: str) -> None:
    """libsbml ends the whole process for some of these."""
    text = made.sbml(made.parameters("false", x="1"), made.rules(x="<ci>x</ci>")).replace(old, new)
    with pytest.raises(UserError) as raised:
        import_file(made.stored(tmp_path, text), tmp_path / "out")
    assert any(reason in one.message for one in raised.value.diagnostics), raised.value.diagnostics
