"""Conditions with categories: their names in tables, and numbers in models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from gbspec.cli.settings import settings
from gbspec.data import BY_NUMBER, SimulateOptions, Trajectories, write
from gbspec.data.sampling import boxes
from gbspec.diagnostics import Findings, Source, UserError
from gbspec.frontend import load_model
from gbspec.ir import Model, whole
from gbspec.operations import analysing, models, tables
from gbspec.passes import examine
from gbspec.passes.override import with_values
from gbspec.syntax import format_text

STRAINS = """model strains
time t from 0
state X in [0, 5] = 0.1
condition strain in {"wild type", mutant, none} = mutant
learn a = 1 in [0.1, 5]
learn b = 2 in [0.1, 5]
let rate = if(strain == "wild type", a, if(strain == mutant, b, 1))
X' = rate*X*(1 - X)
observe X
"""
WIDE = """trajectory,t,X,strain
p,1,0.2,wild type
p,2,0.4,
q,1,0.3,mutant
q,2,0.5,mutant
r,1,0.1,none
r,2,0.1,none
"""
LONG = """trajectory,t,name,value
p,1,X,0.2
p,1,strain,wild type
p,2,X,0.4
q,1,X,0.3
q,1,strain,mutant
q,2,X,0.5
r,1,X,0.1
r,1,strain,none
r,2,X,0.1
"""


def strains(folder: Path) -> Model:
    (folder / "strains.gb").write_text(STRAINS)
    findings = Findings()
    model = load_model(folder / "strains.gb", findings)
    assert not list(findings)
    return model


def read(folder: Path, text: str, model: Model) -> Trajectories:
    (folder / "table.csv").write_text(text)
    return tables.read_data(folder / "table.csv", model, Findings())


def test_names_stand_for_numbers_in_their_order(tmp_path: Path) -> None:
    model = strains(tmp_path)
    (condition,) = model.conditions
    assert condition.categories == ("wild type", "mutant", "none")
    assert condition.default == 1
    (rate,) = model.intermediates
    at = {"a": 1.5, "b": 4.0}
    for number, expected in enumerate((1.5, 4.0, 1.0)):
        values = {symbol: at.get(symbol.name, number) for symbol in rate.value.free_symbols}
        assert float(rate.value.subs(values)) == expected


@pytest.mark.parametrize("text", [WIDE, LONG], ids=["wide", "long"])
def test_cells_hold_names(tmp_path: Path, text: str) -> None:
    """The name `none`, which elsewhere means that nothing was measured, is a category here."""
    data = read(tmp_path, text, strains(tmp_path))
    assert [item.condition.tolist() for item in data.items] == [[0.0], [1.0], [2.0]]
    assert data.to_frame()["strain"].to_list() == ["wild type"] * 2 + ["mutant"] * 2 + ["none"] * 2


@pytest.mark.parametrize("text", [WIDE, LONG], ids=["wide", "long"])
def test_a_misspelt_name_is_reported_with_its_row(tmp_path: Path, text: str) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path, text.replace("wild type", "wild typ"), strains(tmp_path))
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB733"
    assert "`wild typ`" in finding.message
    assert "wild type" in finding.help


@pytest.mark.parametrize("text", [WIDE, LONG], ids=["wide", "long"])
def test_no_value_is_called_missing_that_is_no_category(tmp_path: Path, text: str) -> None:
    model = strains(tmp_path)
    model = replace(model, conditions=tuple(replace(one, default=None) for one in model.conditions))
    with pytest.raises(UserError) as caught:
        read(tmp_path, text.replace("wild type", "Wild type"), model)
    assert {finding.code for finding in caught.value.diagnostics} == {"GB733"}


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_written_table_is_read_again(tmp_path: Path, suffix: str) -> None:
    model = strains(tmp_path)
    data = tables.simulate(models.reference(model), SimulateOptions(trajectories=30, span=4.0, dt=1.0, seed=3))
    assert {float(item.condition[0]) for item in data.items} == {0.0, 1.0, 2.0}
    write(tmp_path / f"out.{suffix}", data, model)
    again = tables.read_data(tmp_path / f"out.{suffix}", model, Findings())
    for one, other in zip(data.items, again.items, strict=True):
        np.testing.assert_array_equal(one.condition, other.condition)


def test_both_constants_can_be_learned(tmp_path: Path) -> None:
    """Each is in a branch of its own, which whole numbers alone reach."""
    findings = Findings()
    examine(strains(tmp_path), findings)
    assert not list(findings)


def test_numbers_that_are_drawn_evenly_give_each_category_as_often(tmp_path: Path) -> None:
    conditions = strains(tmp_path).conditions
    drawn = whole(conditions, np.linspace(0, 2, 3000)[:, None])
    assert np.bincount(drawn[:, 0].astype(int)).tolist() == pytest.approx([1000] * 3, abs=1)
    assert whole(conditions, np.array([0.0, 1.0, 2.0])[:, None])[:, 0].tolist() == [0.0, 1.0, 2.0]


def test_the_formatter_keeps_categories() -> None:
    loose = STRAINS.replace('{"wild type", mutant, none}', '{ "wild type" ,mutant,none }').replace(
        " == mutant", "==mutant"
    )
    assert format_text(Source("strains.gb", loose)) == STRAINS


def test_a_column_of_lists_is_reported(tmp_path: Path) -> None:
    columns = {"t": [1.0, 2.0], "X": [0.2, 0.4], "strain": [["mutant"], ["mutant"]]}
    pl.DataFrame(columns).write_parquet(tmp_path / "lists.parquet")
    (found,) = reported(lambda: tables.read_data(tmp_path / "lists.parquet", strains(tmp_path), Findings()))
    assert found.startswith("GB730")


def reported(made: Callable[[], object]) -> list[str]:
    with pytest.raises(UserError) as caught:
        made()
    return [f"{finding.code} {finding.help}" for finding in caught.value.diagnostics]


@pytest.mark.parametrize("number", [-1.0, 0.5, 3.0])
def test_a_number_of_no_category_is_refused(tmp_path: Path, number: float) -> None:
    model = strains(tmp_path)
    source = models.reference(model)
    for made in (
        lambda: tables.simulate(source, SimulateOptions(condition={"strain": (number, number)})),
        lambda: with_values(model, {"strain": number}),
        lambda: analysing.eigen(source, at=({"X": 0.5, "strain": number},)),
    ):
        assert reported(made) == ['GB383 give a category by its number: 0 "wild type", 1 "mutant", 2 "none"']


def test_a_category_is_no_parameter_of_a_diagram(tmp_path: Path) -> None:
    (found,) = reported(lambda: analysing.bifurcate(models.reference(strains(tmp_path)), "strain", 0.0, 2.0))
    assert found.startswith("GB383")


@pytest.mark.parametrize("read", [lambda text: boxes("--condition")([text]), lambda text: settings([text])])
def test_a_name_in_place_of_the_number_is_explained(read: Callable[[str], object]) -> None:
    (found,) = reported(lambda: read("strain=mutant"))
    assert BY_NUMBER in found


def test_a_category_that_changes_is_told_by_its_names(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path, WIDE.replace("2,0.4,", "2,0.4,mutant"), strains(tmp_path))
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB719"
    assert "from `wild type` to `mutant`" in finding.message and "held" not in finding.help


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_names_that_spreadsheets_take_for_formulas_are_written_as_texts(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "odd.gb").write_text(STRAINS.replace("none}", '"=SUM(A1)"}'))
    model = load_model(tmp_path / "odd.gb", Findings())
    data = tables.simulate(models.reference(model), SimulateOptions(trajectories=20, span=4.0, dt=2.0, seed=3))
    write(tmp_path / f"out.{suffix}", data, model)
    if suffix == "csv":
        assert ",=SUM" not in (tmp_path / "out.csv").read_text()
    again = tables.read_data(tmp_path / f"out.{suffix}", model, Findings())
    assert [item.condition[0] for item in again.items] == [item.condition[0] for item in data.items]
    assert 2.0 in {item.condition[0] for item in again.items}
