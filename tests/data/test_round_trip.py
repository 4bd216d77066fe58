"""Tables that are written are read back equal; any text gives a table or diagnostics, never a traceback."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gbspec.data.fingerprints import fingerprint
from gbspec.data.table import read, write
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories, Trajectory
from gbspec.diagnostics import Findings, UserError
from gbspec.ir.model import Channel, Condition, Dose, Input, Model, State, Time, symbol
from tests.data.hand_models import patient, reactor, tank


def told(x: float) -> float:
    """The number, or zero if it is so small that a table of such numbers is refused."""
    return x if abs(x) > 1e-90 else 0.0


finite = st.floats(-1e99, 1e99).map(told)
positive = st.floats(min_value=1e-99, max_value=1e99)
label = st.text(st.characters(codec="utf-8", exclude_characters="\0\r\ufeff"), min_size=1, max_size=8).map(str.strip)


def rich(start: float | None) -> Model:
    """Two channels, two conditions, inputs of both kinds, doses."""
    states = (State("x"), State("y"))
    return Model(
        "rich",
        time=Time("t", start=start),
        states=states,
        conditions=(Condition("c"), Condition("d", default=1.0)),
        inputs=(Input("u", interpolation="held"), Input("v", interpolation="linear")),
        channels=(*(Channel(s.name, value=symbol(s.name), state=i) for i, s in enumerate(states)),),
        doses=(Dose("x"),),
    )


@st.composite
def trajectories(draw: st.DrawFn, start: float | None) -> Trajectory:
    """A trajectory that a table can hold: measured in each of its rows, inputs known from the start."""
    moments = draw(st.lists(st.floats(0.0, 1e6).map(told), min_size=3, max_size=12, unique=True).map(sorted))
    grid = np.array(moments)
    count = draw(st.integers(1, len(grid)))
    picked = sorted(draw(st.permutations(range(len(grid))))[:count])
    times = grid[picked]
    first = float(grid[0]) if start is None else start
    values = np.array(draw(st.lists(st.tuples(finite, finite), min_size=count, max_size=count))).reshape(count, 2)
    hidden = draw(st.lists(st.integers(0, 2), min_size=count, max_size=count))
    for row, which in enumerate(hidden):  # 2: both measured
        if which < 2:
            values[row, which] = np.nan
    sd = np.array(draw(st.lists(st.tuples(positive, positive), min_size=count, max_size=count))).reshape(count, 2)
    sd[np.isnan(values)] = np.nan

    def signal() -> Signal:
        later = [float(t) for t in grid if t > first]
        jumps = sorted({first, *(draw(st.lists(st.sampled_from(later), max_size=3)) if later else [])})
        return Signal(np.array(jumps), np.array([draw(finite) for _ in jumps]))

    given_at = sorted(set(draw(st.lists(st.sampled_from([float(t) for t in grid]), max_size=3))))
    dose = DoseEvents(np.array(given_at), np.array([draw(finite) for _ in given_at]))
    return Trajectory(
        label=draw(label.filter(bool)),
        start=first,
        times=times,
        values=values,
        counts=(~np.isnan(values)).astype(float),
        sd=sd,
        condition=np.array([draw(finite), draw(finite)]),
        inputs=(signal(), signal()),
        doses=(dose,),
    )


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet"])
@pytest.mark.parametrize("start", [None, 0.0])
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_what_is_written_reads_back(data: st.DataObject, start: float | None, suffix: str) -> None:
    model = rich(start)
    items = data.draw(st.lists(trajectories(start), min_size=1, max_size=3, unique_by=lambda item: item.label))
    whole = Trajectories(tuple(items), ("x", "y"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"t{suffix}"
        write(path, whole, model)
        back = read(path, model, Findings())
    assert [item.label for item in back.items] == [item.label for item in items]
    for one, other in zip(back.items, items, strict=True):
        assert one.start == other.start
        for name in ("times", "values", "counts", "sd", "condition"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        for mine, theirs in zip(one.inputs, other.inputs, strict=True):
            np.testing.assert_array_equal(mine.times, theirs.times)
            np.testing.assert_array_equal(mine.values, theirs.values)
        np.testing.assert_array_equal(one.doses[0].times, other.doses[0].times)
        np.testing.assert_array_equal(one.doses[0].amounts, other.doses[0].amounts)
    assert {fingerprint(item) for item in back.items} == {fingerprint(item) for item in items}


def test_a_fingerprint_is_of_the_content() -> None:
    times, values = np.array([0.0, 1.0]), np.array([[1.0], [np.nan]])
    base = {"start": 0.0, "times": times, "values": values, "counts": values, "sd": values, "condition": np.zeros(1)}
    one, renamed = Trajectory(label="a", **base), Trajectory(label="b", **base)  # type: ignore[arg-type]  # by name
    other = Trajectory(label="a", **{**base, "times": np.array([1e-15, 1.0])})  # type: ignore[arg-type]
    assert fingerprint(one) == fingerprint(renamed)
    assert fingerprint(one) != fingerprint(other)
    assert fingerprint(one) == fingerprint(Trajectory(label="a", **{**base, "condition": -np.zeros(1)}))  # type: ignore[arg-type]


def test_a_table_read_for_prediction_has_the_fingerprints_of_training(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t,V,F\n0,1,2\n1,,3\n2,4,\n3,,5\n")
    for text in ("t,V,F\n0,1,2\n1,,3\n2,4,\n3,,5\n", "t,name,value\n0,V,1\n0,F,2\n1,F,3\n2,V,4\n3,F,5\n"):
        (tmp_path / "t.csv").write_text(text)
        both = [read(tmp_path / "t.csv", tank(), Findings(), required) for required in (True, False)]
        assert [len(table.items[0].times) for table in both] == [2, 4]
        assert fingerprint(both[0].items[0]) == fingerprint(both[1].items[0])


def test_tables_are_not_written_as_anything(tmp_path: Path) -> None:
    empty = Trajectories((), ("V",))
    for name, code in (("t.xlsx", "GB812"), ("no/such/folder/t.csv", "GB701"), ("no/such/t.parquet", "GB701")):
        with pytest.raises(UserError) as caught:
            write(tmp_path / name, empty, tank())
        assert caught.value.diagnostics[0].code == code
        if code == "GB701":
            assert caught.value.diagnostics[0].message == f"cannot write `{tmp_path / name}`: No such file or directory"


pieces = st.sampled_from(["0", "1", "-1", "2.5", "1e400", "NA", '"', '""', ",", ",,", "\n", "\r", "\t", " ", "x1", "t",
                          "name", "value", "Da", "sd_x1", "trajectory", "inf", "µ", "\ufeff", "\0", ";"])  # fmt: skip
random_text = st.lists(pieces, max_size=60).map("".join)
table_like = st.lists(st.lists(st.sampled_from(["0", "1", "2", "0.3", "", "NA", "x1", "Da", "-", "1e3", '"3"', "inf"]),
                               min_size=4, max_size=6).map(",".join), max_size=8).map("\n".join)  # fmt: skip


@settings(max_examples=400, deadline=None)
@given(text=st.one_of(random_text, table_like, table_like.map(lambda rows: "trajectory,t,x1,x2,Da\n" + rows),
                      table_like.map(lambda rows: "t,name,value,sd\n" + rows)),
       model=st.sampled_from([reactor(), tank(), patient()]), measured=st.booleans())  # fmt: skip
@example(text='t,V,F\n"1\n",2,3\n', model=tank(), measured=True)
@example(text='t\n""\n', model=tank(), measured=False)
def test_no_text_gives_a_traceback(text: str, model: Model, measured: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.csv"
        path.write_bytes(text.encode())
        try:
            found = read(path, model, Findings(), measured)
        except UserError:
            return
    for item in found.items:
        assert np.all(np.diff(item.times) > 0)
        assert np.isfinite(item.times).all() and np.isfinite(item.condition).all()
        assert not np.isinf(item.values).any()


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=200), suffix=st.sampled_from([".csv", ".tsv", ".parquet"]))
def test_no_bytes_give_a_traceback(data: bytes, suffix: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"t{suffix}"
        path.write_bytes(data)
        with pytest.raises(UserError):
            read(path, reactor(), Findings())
