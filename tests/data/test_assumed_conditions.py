"""Conditions of which a table has no value, so that they have the default of the model."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.data import Trajectories, read
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.frontend import load_model

MODEL = """model fall
time t
condition T in [280, 320] = 300
condition strain in {wild, mutant} = wild
learn k = 0.5 > 0
state x = 1
x' = -k*x*exp((T - 300)/20)*if(strain == wild, 1, 2)
observe x
"""


def found(folder: Path, table: str) -> tuple[Trajectories, list[Diagnostic]]:
    (folder / "m.gb").write_text(MODEL)
    (folder / "d.csv").write_text(table)
    findings = Findings()
    return read(folder / "d.csv", load_model(folder / "m.gb", Findings()), findings), list(findings)


WIDE = "trajectory,t,T,strain,x\na,0,290,wild,1\na,1,,,0.6\nb,0,{T},{strain},1\nb,1,{T},{strain},0.5\n"


def test_a_table_with_all_values_has_no_assumed_ones(tmp_path: Path) -> None:
    data, said = found(tmp_path, WIDE.format(T=300, strain="wild"))
    assert not said, "the default that is written in the table is known"
    assert [item.assumed for item in data.items] == [(), ()]
    assert data.items[0].at_rows(slice(1)).assumed == ()


@pytest.mark.parametrize(
    ("T", "strain", "assumed", "message"),
    [
        ("", "mutant", (0,), "`T` is empty in 1 of 2 trajectories (`b`): its default, 300, is taken there"),
        ("310", "", (1,), "`strain` is empty in 1 of 2 trajectories (`b`): its default, `wild`, is taken there"),
    ],
)
def test_empty_cells_of_some_trajectories_are_told(
    tmp_path: Path, T: str, strain: str, assumed: tuple[int, ...], message: str
) -> None:
    data, (said,) = found(tmp_path, WIDE.format(T=T, strain=strain))
    assert (said.code, said.message, said.place.row) == ("GB793", message, 4)  # type: ignore[union-attr]
    assert [item.assumed for item in data.items] == [(), assumed]
    assert data.items[1].at_rows(slice(1)).assumed == assumed


def test_a_column_without_any_value_is_told(tmp_path: Path) -> None:
    _, (said,) = found(tmp_path, "trajectory,t,T,strain,x\na,0,,wild,1\na,1,,wild,0.6\n")
    assert said.message == "`T` is empty in all trajectories: its default, 300, is taken there"


def test_rows_of_the_long_layout_count_alike(tmp_path: Path) -> None:
    rows = "trajectory,t,name,value\na,0,T,290\na,0,x,1\na,1,x,0.6\nb,0,x,1\nb,1,x,0.5\n"
    data, (said,) = found(tmp_path, rows)
    assert (said.code, [item.assumed for item in data.items]) == ("GB793", [(1,), (0, 1)])


def test_a_table_without_the_columns_reads_as_the_model_says(tmp_path: Path) -> None:
    data, said = found(tmp_path, "trajectory,t,x\na,0,1\na,1,0.6\n")
    assert not said
    assert [item.assumed for item in data.items] == [(0, 1)]


@pytest.mark.parametrize("default", [" = wild", ""])
def test_a_cell_that_is_no_category_is_not_called_empty(tmp_path: Path, default: str) -> None:
    (tmp_path / "m.gb").write_text(MODEL.replace("mutant} = wild", "mutant}" + default))
    (tmp_path / "d.csv").write_text(WIDE.format(T=300, strain="Wild"))
    with pytest.raises(UserError) as caught:
        read(tmp_path / "d.csv", load_model(tmp_path / "m.gb", Findings()), Findings())
    assert {one.code for one in caught.value.diagnostics} == {"GB733"}
