"""Valid tables of every layout and format are read to the right trajectories."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from gbspec.data.table import Trajectories, read
from gbspec.diagnostics import Findings
from gbspec.ir.model import Channel, Condition, symbol
from tests.data.hand_models import patient, reactor, tank
from tests.data.reader import Reader
from tests.effort import calls

WIDE = """\
trajectory,t,x1,x2,Da
a,0,0.5,1.5,0.3
a,0.5,0.52,,0.3
b,0,,1.0,0.25
b,0.25,,,
b,1e0,0.4,NA,
"""


def test_a_wide_table(reading: Reader) -> None:
    found, findings = reading(WIDE)
    assert findings == [] and found is not None
    assert [item.label for item in found.items] == ["a", "b"]
    a, b = found.items
    np.testing.assert_array_equal(a.values, [[0.5, 1.5], [0.52, np.nan]])
    np.testing.assert_array_equal(a.counts, [[1, 1], [1, 0]])
    np.testing.assert_array_equal(b.times, [0, 1])  # the row at 0.25 measures nothing
    np.testing.assert_array_equal(b.values, [[np.nan, 1.0], [0.4, np.nan]])
    assert (a.condition.tolist(), b.condition.tolist()) == ([0.3], [0.25])
    assert (found.rows, found.measurements, found.channels) == (5, 5, ("x1", "x2"))
    assert np.isnan(a.sd).all()


def test_the_file_is_identified(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(WIDE)
    found = read(path, reactor(), Findings())
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert found.path == str(path)


@pytest.mark.parametrize("label", ["x^2", "x\u06aa", "x\x01", "x"])
def test_a_first_label_that_begins_like_compressed_data(reading: Reader, label: str) -> None:
    # zlib's streams begin with these bytes, and polars unpacked them
    found, findings = reading(f"trajectory,t,x1,x2,Da\n{label},0,0.5,1.5,0.3\n{label},1,0.6,1.5,0.3\n")
    assert findings == [] and found is not None
    assert [item.label for item in found.items] == [label] and found.items[0].values.shape == (2, 2)


@pytest.mark.parametrize("change", [
    lambda text: text.replace("\n", "\r\n"),
    lambda text: text.replace("\n", "\r"),
    lambda text: "\ufeff" + text,
    lambda text: text.rstrip("\n"),
    lambda text: text.replace("\na,0.5", "\n\n  \n,,,,\na,0.5"),
    lambda text: text.replace("trajectory,t", '"trajectory"," t "'),
    lambda text: text.replace(",0.52,", ', "0.52" ,').replace(', "', ',"').replace('" ,', '",'),
    lambda text: text.replace("NA", " - ").replace(",,0.3", ",n/a,0.3"),
    lambda text: text.replace("x1", "ｘ1"),
])  # fmt: skip
def test_what_does_not_matter(reading: Reader, change: object) -> None:
    plain, _ = reading(WIDE)
    found, findings = reading(change(WIDE))  # type: ignore[operator]  # a function of a text
    assert findings == [] and found is not None and plain is not None
    for one, other in zip(found.items, plain.items, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.times, other.times)


def test_tabs_and_parquet_say_the_same(reading: Reader, tmp_path: Path) -> None:
    plain, _ = reading(WIDE)
    tabs, findings = reading(WIDE.replace(",", "\t"), name="t.tsv")
    assert findings == []
    frame = pl.DataFrame(
        {
            "trajectory": ["a", "a", "b", "b", "b"],
            "t": [0.0, 0.5, 0.0, 0.25, 1.0],
            "x1": [0.5, 0.52, None, float("nan"), 0.4],
            "x2": [1.5, None, 1.0, None, None],
            "Da": [0.3, 0.3, 0.25, None, None],
        }
    )
    frame.write_parquet(tmp_path / "t.parquet")
    parquet = read(tmp_path / "t.parquet", reactor(), Findings())
    assert plain is not None and tabs is not None
    for other in (tabs, parquet):
        for one, two in zip(plain.items, other.items, strict=True):
            assert one.label == two.label
            np.testing.assert_array_equal(one.values, two.values)


def test_labels_are_the_same_for_every_file_format(tmp_path: Path) -> None:
    frame = pl.DataFrame({"trajectory": [1.0, 1.0, 2.5, 2.5], "t": [0, 1, 0, 1], "V": [1, 2, 3, 4]})
    frame.write_parquet(tmp_path / "t.parquet")
    found = read(tmp_path / "t.parquet", tank(default=0.0), Findings())
    assert [item.label for item in found.items] == ["1", "2.5"]


def test_one_trajectory_needs_no_label(reading: Reader) -> None:
    found, findings = reading("t,x1,x2,Da\n0,0.5,1,0.3\n1,0.6,1,0.3\n")
    assert findings == [] and found is not None
    assert [item.label for item in found.items] == ["1"]


def test_the_time_may_be_called_like_the_models(reading: Reader) -> None:
    from gbspec.ir.model import Time

    named = reactor(time=Time("hours"))
    for column in ("hours", "t"):
        found, findings = reading(f"{column},x1,x2,Da\n0,0.5,1,0.3\n1,0.6,1,0.3\n", named)
        assert findings == [] and found is not None
    both, findings = reading("hours,t,x1,x2,Da\n0,9,0.5,1,0.3\n1,8,0.6,1,0.3\n", named)
    assert [d.code for d in findings] == ["GB711"] and both is not None
    np.testing.assert_array_equal(both.items[0].times, [0, 1])


def test_rows_of_trajectories_may_be_interleaved(reading: Reader) -> None:
    found, findings = reading("trajectory,t,x1,x2,Da\n1,0,.1,1,.3\n2,0,.2,1,.4\n1,1,.3,1,.3\n2,1,.4,1,.4\n")
    assert findings == [] and found is not None
    assert [item.values[:, 0].tolist() for item in found.items] == [[0.1, 0.3], [0.2, 0.4]]


def test_columns_may_have_other_names(reading: Reader) -> None:
    found, findings = reading("t,plasma mg/L,sd_plasma mg/L,dose_S\n1,2.5,0.1,\n2,2,,100\n", patient())
    assert findings == [] and found is not None
    (item,) = found.items
    assert item.start == 0.0
    np.testing.assert_array_equal(item.sd, [[0.1], [np.nan]])
    assert (item.doses[0].times.tolist(), item.doses[0].amounts.tolist()) == ([2.0], [100.0])


def test_a_dose_may_have_a_separate_row(reading: Reader) -> None:
    found, findings = reading("t,plasma mg/L,dose_S\n0,,100\n1,2.5,\n2,2,\n", patient())
    assert findings == [] and found is not None
    assert found.items[0].times.tolist() == [1, 2]
    assert found.items[0].doses[0].times.tolist() == [0]


def test_an_input_keeps_its_filled_cells(reading: Reader) -> None:
    found, findings = reading("t,V,F\n0,,0.1\n1,1.1,\n2,,0.3\n3,1.6,\n", tank())
    assert findings == [] and found is not None
    (item,) = found.items
    assert item.start == 0.0 and item.times.tolist() == [1, 3]
    assert item.inputs[0].times.tolist() == [0, 2]
    assert item.inputs[0].values.tolist() == [0.1, 0.3]


def test_defaults_replace_missing_values(reading: Reader) -> None:
    found, findings = reading("t,V\n0,1\n1,2\n", tank(default=0.7))
    assert findings == [] and found is not None
    assert found.items[0].inputs[0].values.tolist() == [0.7]
    late, findings = reading("t,V,F\n0,1,\n1,2,0.2\n", tank(default=0.7))
    assert findings == [] and late is not None
    assert late.items[0].inputs[0].times.tolist() == [0, 1]
    assert late.items[0].inputs[0].values.tolist() == [0.7, 0.2]
    model = reactor(conditions=(Condition("Da", default=0.4),))
    found, findings = reading("trajectory,t,x1,x2,Da\n1,0,.5,1,\n1,1,.5,1,\n2,0,.5,1,.3\n2,1,.5,1,\n", model)
    assert [one.code for one in findings] == ["GB793"] and found is not None
    assert [item.condition.tolist() for item in found.items] == [[0.4], [0.3]]


def test_a_table_to_predict_on_keeps_every_row(reading: Reader) -> None:
    found, findings = reading("t,Da,x1\n0,0.3,0.5\n1,,\n2,,\n", require_channels=False)
    assert findings == [] and found is not None
    assert found.items[0].times.tolist() == [0, 1, 2]
    assert found.items[0].counts.sum() == 1


LONG = """\
trajectory,t,name,value,sd
b,1,x1,0.4,
a,0.5,x1,0.52,0.02
a,0,x1,0.5,0.02
a,0,Da,0.3,
b,0,x2,1.0,
a,0,x2,1.4,0.3
a,0,x2,1.6,0.4
b,0,Da,0.25,
b,3,x2,,
"""


def test_a_long_table(reading: Reader) -> None:
    found, findings = reading(LONG)
    assert findings == [] and found is not None
    by_label = {item.label: item for item in found.items}
    a, b = by_label["a"], by_label["b"]
    np.testing.assert_array_equal(a.times, [0, 0.5])
    np.testing.assert_array_equal(a.values, [[0.5, 1.5], [0.52, np.nan]])
    np.testing.assert_array_equal(a.counts, [[1, 2], [1, 0]])
    np.testing.assert_allclose(a.sd, [[0.02, 0.25], [0.02, np.nan]])  # sqrt(0.3^2 + 0.4^2)/2
    np.testing.assert_array_equal(b.values, [[np.nan, 1.0], [0.4, np.nan]])
    assert (a.condition.tolist(), b.condition.tolist()) == ([0.3], [0.25])
    assert found.measurements == 6


def test_the_order_of_rows_of_a_long_table_does_not_matter(reading: Reader) -> None:
    head, *rows = LONG.splitlines()
    plain, _ = reading(LONG)
    turned, findings = reading("\n".join([head, *reversed(rows)]) + "\n")
    assert findings == [] and plain is not None and turned is not None
    ours = {item.label: item for item in turned.items}
    for item in plain.items:
        np.testing.assert_allclose(ours[item.label].values, item.values)


def test_inputs_and_doses_of_a_long_table(reading: Reader) -> None:
    found, findings = reading("t,name,value\n0,F,0.1\n0,V,1\n2,F,0.3\n2,F,0.3\n3,V,1.6\n", tank())
    assert findings == [] and found is not None
    assert found.items[0].inputs[0].times.tolist() == [0, 2]
    found, findings = reading("t,name,value\n1,plasma mg/L,1\n1,dose_S,50\n1,dose_S,25\n2,plasma mg/L,2\n", patient())
    assert findings == [] and found is not None
    assert found.items[0].doses[0].amounts.tolist() == [50, 25]


def test_name_and_value_may_be_channels(reading: Reader) -> None:
    model = reactor(
        channels=(Channel("name", value=symbol("x1"), state=0), Channel("value", value=symbol("x2"), state=1))
    )
    found, findings = reading("t,name,value,Da\n0,0.5,1,0.3\n1,0.6,2,0.3\n", model)
    assert findings == [] and found is not None
    assert found.meta["layout"] == "wide"


def test_many_rows_are_not_read_row_by_row(tmp_path: Path) -> None:
    n = 250_000
    index = np.arange(n)
    frame = pl.DataFrame({"trajectory": index // 1000, "t": (index % 1000) * 0.01, "V": index * 0.7, "F": index % 7})
    frame.write_csv(tmp_path / "big.csv")
    found: list[Trajectories] = []
    assert calls(lambda: found.append(read(tmp_path / "big.csv", tank(), Findings()))) < n
    assert len(found[0]) == n // 1000 and found[0].measurements == n


@pytest.mark.parametrize("above", ["", "# made by a reactor\n# on a Tuesday\n"])
def test_semicolons_decimal_commas_and_comments_above_the_header(reading: Reader, above: str) -> None:
    plain, findings = reading(WIDE)
    table = WIDE.replace(",", ";").replace(".", ",")
    found, findings = reading(above + table)
    assert findings == [] and found is not None and plain is not None
    for one, other in zip(found.items, plain.items, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        assert one.condition.tolist() == other.condition.tolist()


def test_rows_are_counted_with_the_comments_above(reading: Reader) -> None:
    _, findings = reading("# made by a reactor\n" + WIDE.replace("0.52", "half"))
    assert [(d.code, d.place.row) for d in findings] == [("GB712", 4)]  # type: ignore[union-attr]
