"""Tables in the form of NONMEM mean what the ordinary tables of the same experiments mean."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories, format_named
from gbspec.data.fingerprints import fingerprint
from gbspec.data.table import read, read_frame
from gbspec.data.trajectories import RunIn
from gbspec.diagnostics import Findings, UserError
from gbspec.ir.model import Channel, Condition, Model, State, symbol
from tests.data.hand_models import drip
from tests.training.conftest import model_of

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
ORAL = """model oral
time t : h from 0
state gut : mg
state plasma : mg/L
condition weight_kg = 70
learn ka : 1/h = 1.5 in [0.1, 20]
learn CL : L/h = 3 in [0.1, 50]
learn V : L = 30 in [1, 300]
dose gut
gut' = -ka*gut
plasma' = ka*gut/V - CL/V*plasma
initial gut = 0
initial plasma = 0
observe conc : mg/L = plasma
"""
NEWBORN = """model newborn
time t : h from 0
state A : mg
learn CL : L/h = 0.006 in [0.0005, 0.1]
learn V : L = 1.4 in [0.1, 10]
dose A
A' = -CL/V*A
initial A = 0
observe conc = A/V : mg/L
"""


def rows_of(name: str) -> list[dict[str, str]]:
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"{name} is not there: the shared tables are not part of the project")
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def written(path: Path, rows: list[list[object]]) -> Path:
    path.write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n", encoding="utf-8")
    return path


def same(one: Trajectories, other: Trajectories) -> bool:
    """Whether both have the same labels and numbers, so that a fit of them is the same."""
    return [(i.label, fingerprint(i)) for i in one.items] == [(i.label, fingerprint(i)) for i in other.items]


def test_theophylline_reads_as_the_ordinary_table(tmp_path: Path) -> None:
    model, plain, events, before = model_of(ORAL), [], [], ""
    for row in rows_of("theophylline.csv"):
        who, t, amount = row["trajectory"], row["t"], row["dose_mg"]
        first, before = who != before, who
        if first:
            events.append([who, t, amount, 1, 1, ".", 1, row["weight_kg"]])
        plain.append([who, t, row["conc"], amount if first else "", row["weight_kg"]])
        events.append([who, t, ".", 0, 2, row["conc"], 0, row["weight_kg"]])
    ordinary = written(tmp_path / "a.csv", [["trajectory", "t", "conc", "dose_gut", "weight_kg"], *plain])
    nonmem = written(tmp_path / "b.csv", [["ID", "TIME", "AMT", "EVID", "CMT", "DV", "MDV", "weight_kg"], *events])
    findings = Findings()
    assert same(read(ordinary, model, findings), read(nonmem, model, findings, form=format_named("nonmem")))
    assert list(findings) == []


def test_phenobarbital_reads_as_the_ordinary_table(tmp_path: Path) -> None:
    events: list[list[object]] = [["ID", "TIME", "AMT", "DV"]]
    for row in rows_of("phenobarbital.csv"):
        if row["conc"]:
            events.append([row["trajectory"], row["t"], ".", row["conc"]])
        if row["dose_A"]:
            events.append([row["trajectory"], row["t"], row["dose_A"], "."])
    model = model_of(NEWBORN)
    ordinary, findings = read(SHARED / "phenobarbital.csv", model, Findings()), Findings()
    assert same(ordinary, read(written(tmp_path / "b.csv", events), model, findings))
    assert list(findings) == []


Cells = list[float | None] | list[int] | list[str] | list[float]


def made(model: Model, form: str = "auto", **columns: Cells) -> tuple[Trajectories, Findings]:
    findings = Findings()
    return read_frame(columns, model, findings, form=format_named(form)), findings


def test_rates_and_durations_of_the_model() -> None:
    data, _ = made(drip(symbol("t") * 0 + 4), ID=[1, 1, 1, 1], TIME=[0, 10, 20, 30], AMT=[8, 8, 8, 0],
                   RATE=[-2, 2, 0, 0], DV=[None, None, None, 1.0])  # fmt: skip
    (item,) = data.items
    assert item.inputs[0].times.tolist() == [0, 4, 10, 14] and item.inputs[0].values.tolist() == [2, 0, 2, 0]
    assert item.doses[0].times.tolist() == [20]


def test_a_steady_state_and_additional_doses() -> None:
    data, _ = made(drip(None), ID=[7, 7], TIME=[0, 5], AMT=[8, 0], II=[12, 0], ADDL=[1, 0], SS=[1, 0], EVID=[1, 0],
                   DV=["", "2"])  # fmt: skip
    (item,) = data.items
    assert item.label == "7" and item.run_in == RunIn(12, 100)
    assert item.doses[0].times[-2:].tolist() == [0, 12] and len(item.doses[0].times) == 102


def test_a_reset_begins_another_trajectory() -> None:
    data, findings = made(drip(None), ID=[1] * 6, TIME=[0, 5, 9, 9, 0, 5], EVID=[1, 0, 3, 0, 4, 0],
                          AMT=[1, 0, 0, 0, 2, 0], DV=[None, 1, None, 2, None, 3.0])  # fmt: skip
    assert [item.label for item in data.items] == ["1", "1 (2)", "1 (3)"]
    assert [item.start for item in data.items] == [0, 9, 0]
    assert [item.values.ravel().tolist() for item in data.items] == [[1], [2], [3]]
    assert data.items[2].doses[0].amounts.tolist() == [2]
    assert list(findings) == []


def two() -> Model:
    states = (State("a", initial=drip().states[0].initial), State("b", initial=drip().states[0].initial))
    channels = (Channel("b", symbol("b"), 1), Channel("sum", symbol("a") + symbol("b")))
    one = drip(None)
    return Model("two", time=one.time, states=states, channels=channels, doses=one.doses[:0])


def test_numbers_of_compartments_by_order_and_by_name() -> None:
    columns: dict[str, Cells] = {"ID": [1, 1, 1], "TIME": [0, 1, 2], "DV": [1.0, 2.0, 3.0]}
    data, _ = made(two(), "nonmem:1=sum,2=b", CMT=[2, 1, 2], **columns)
    assert np.array_equal(data.items[0].values, [[1, np.nan], [np.nan, 2], [3, np.nan]], equal_nan=True)
    data, _ = made(two(), DVID=[1, 2, 1], **columns)
    assert np.array_equal(data.items[0].values, [[1, np.nan], [np.nan, 2], [3, np.nan]], equal_nan=True)
    with pytest.raises(UserError) as caught:
        made(two(), CMT=[2, 1, 2], **columns)
    assert [(d.code, d.place.row) for d in caught.value.diagnostics] == [("GB761", 1)]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("code", "columns"),
    [
        ("GB760", {"AMT": [8, 0], "EVID": [5, 0]}),
        ("GB760", {"AMT": [8, 0], "RATE": [-1, 0]}),
        ("GB760", {"AMT": [8, 0], "RATE": [-7, 0]}),
        ("GB760", {"AMT": [8, 0], "SS": [2, 0], "II": [12, 0]}),
        ("GB760", {"AMT": [0, 0], "RATE": [3, 0]}),
        ("GB760", {"AMT": [8, 0], "CMT": [-1, 1]}),
        ("GB761", {"AMT": [8, 0], "CMT": [3, 1]}),
        ("GB714", {"AMT": [8, 0], "TIME": [0, None]}),
        ("GB715", {"AMT": [8, 0], "TIME": [5, 1]}),
        ("GB712", {"AMT": [8, 0], "DV": ["", "BLQ"]}),
        ("GB748", {"AMT": [8, 0], "RATE": [4, 0]}),
    ],
)
def test_wrong_events_get_their_code(code: str, columns: dict[str, Cells]) -> None:
    with pytest.raises(UserError) as caught:
        made(drip(None), "nonmem", **{"ID": [1, 1], "TIME": [0, 5], "DV": [None, 2.0], **columns})
    assert code in {d.code for d in caught.value.diagnostics}


def test_a_measurement_behind_a_dose_of_the_same_time_is_pointed_out() -> None:
    columns: dict[str, Cells] = {"ID": [1, 1, 1], "TIME": [0, 0, 5], "DV": [None, 2.0, 1.0], "AMT": [8, 0, 0]}
    assert [d.code for d in made(drip(None), **columns)[1]] == ["GB762"]


def test_censored_values_by_cens_and_by_sign() -> None:
    data, _ = made(drip(None), ID=[1, 1, 1, 1], TIME=[0, 2, 3, 5], AMT=[8, 0, 0, 0], CENS=[0, 1, -1, 0],
                   DV=["", "2", "1", "<0.5"])  # fmt: skip
    limits = data.items[0].censored
    assert limits.side.ravel().tolist() == [-1, 1, -1] and limits.value.ravel().tolist() == [2, 1, 0.5]


def test_conditions_and_inputs_have_their_columns() -> None:
    model = drip(None, conditions=(Condition("w"),))
    data, _ = made(model, ID=[1, 1], TIME=[0, 2], AMT=[8, 0], DV=[None, 2.0], w=[70.0, None])
    assert data.items[0].condition.tolist() == [70] and data.items[0].values.tolist() == [[2]]
    with pytest.raises(UserError) as caught:
        made(model, ID=[1, 1], TIME=[0, 2], AMT=[8, 0], DV=[None, 2.0])
    assert "GB710" in {d.code for d in caught.value.diagnostics}


def test_subjects_of_a_population_are_not_reset() -> None:
    text = NEWBORN.replace("in [0.0005, 0.1]", "in [0.0005, 0.1] per trajectory ~ lognormal")
    with pytest.raises(UserError) as caught:
        made(model_of(text), ID=[1, 1, 1], TIME=[0, 5, 6], DV=[None, 2.0, 1.0], AMT=[8, 0, 0], EVID=[1, 0, 3])
    assert [d.code for d in caught.value.diagnostics] == ["GB763"]


@pytest.mark.parametrize("text", ["monolix", "nonmem:gut=1", "table:1=gut", "nonmem:", "nonmem:1=nothing"])
def test_forms_that_do_not_exist(text: str) -> None:
    with pytest.raises(UserError) as caught:
        made(drip(None), text, ID=[1], TIME=[1], DV=[2.0])
    assert [d.code for d in caught.value.diagnostics] == ["GB759"]


def test_the_form_is_recognised_only_where_the_model_has_no_such_names() -> None:
    own = Model("own", states=(State("DV"),), channels=(Channel("DV", symbol("DV"), 0, column="DV"),))
    data, _ = made(own, trajectory=[1, 1], t=[0, 1], DV=[1.0, 2.0], ID=[1, 1], TIME=[5, 6])
    assert data.meta == {"layout": "wide"} and data.items[0].times.tolist() == [0, 1]
