"""Every mistake in a table gets its code, with the row and column as in a spreadsheet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import sympy

from gbspec.data.table import read
from gbspec.diagnostics import Cell, Diagnostic, Findings, Severity, UserError
from gbspec.diagnostics.catalogue import entries
from gbspec.ir.model import Channel, Condition, Initial, Learnable, Model, Time, symbol
from tests.data.hand_models import decay, drip, growth, patient, reactor, tank
from tests.data.reader import Reader

HEAD = "trajectory,t,x1,x2,Da\n"
FIRST = "1,0,0.5,1.5,0.3\n"

# text, model, then (code, row, column) of every diagnostic
WRONG: dict[str, tuple[str, Model, list[tuple[str, int | None, str | None]]]] = {
    "empty file": ("", reactor(), [("GB704", None, None)]),
    "header alone": (HEAD, reactor(), [("GB704", 1, None)]),
    "bars": ("t|x1|x2|Da\n0|1|2|3\n", reactor(), [("GB705", 1, None)]),
    "thousands among semicolons": (
        "t;x1;x2;Da\n0;0,5;1,5;0,3\n1;1.000,5;1;0,3\n",
        reactor(),
        [("GB712", 3, "x1")],
    ),
    "a comment among the rows": (HEAD + FIRST + "# later\n1,1,0.5,1,0.3\n", reactor(), [("GB708", 3, None)]),
    "tabs in a csv": ("t\tx1\tx2\tDa\n0\t1\t2\t3\n", reactor(), [("GB705", 1, None)]),
    "no header": ("0,0.5,1.5,0.3\n1,0.5,1.5,0.3\n", reactor(), [("GB706", 1, None)]),
    "column twice": ("t,x1,x1,Da\n0,1,2,3\n", reactor(), [("GB707", 1, "x1")]),
    "ragged": (HEAD + FIRST + "1,1,0.5\n1,2,0.5,1,0.3,9\n", reactor(), [("GB708", 3, None), ("GB708", 4, None)]),
    "ragged after blank rows": (HEAD + FIRST + "\n\n1,1,0.5\n", reactor(), [("GB708", 5, None)]),
    "open quote": (HEAD + '1,0,"0.5,1.5,0.3\n', reactor(), [("GB709", None, None)]),
    "quote within a cell": (HEAD + '1,0,0"5,1"5,0.3\n', reactor(), [("GB708", 2, None)]),
    "missing columns": ("t,x1\n0,1\n1,1\n", reactor(), [("GB710", 1, "x2"), ("GB710", 1, "Da")]),
    "misspelt column": ("t,x1,X2,Da\n0,.5,1,.3\n1,.5,1,.3\n", reactor(), [("GB710", 1, "x2")]),
    "no time": ("time,x1,x2,Da\n0,.5,1,.3\n1,.5,1,.3\n", reactor(), [("GB710", 1, "t")]),
    "no dose": ("t,plasma mg/L\n0,1\n1,1\n", patient(), [("GB710", 1, "dose_S")]),
    "surplus column": ("t,x1,x2,Da,note\n0,.5,1,.3,\n1,.5,1,.3,\n", reactor(), [("GB711", 1, "note")]),
    "not a number": (HEAD + FIRST + "1,1,oops,1.5,0.3\n", reactor(), [("GB712", 3, "x1")]),
    "decimal comma": (HEAD + FIRST + '1,1,"0,5",1.5,0.3\n', reactor(), [("GB712", 3, "x1")]),
    "time not a number": (HEAD + FIRST + "1,noon,0.5,1.5,0.3\n", reactor(), [("GB712", 3, "t")]),
    "infinite": (HEAD + FIRST + "1,1,inf,1e999,0.3\n", reactor(), [("GB713", 3, "x1"), ("GB713", 3, "x2")]),
    "huge": (HEAD + FIRST + "1,1,0.5,1e308,0.3\n", reactor(), [("GB731", 3, "x2")]),
    "huge time": (HEAD + FIRST + "1,1e308,0.5,1,0.3\n", reactor(), [("GB731", 3, "t")]),
    "tiny times": (HEAD + FIRST + "1,5e-324,0.5,1,0.3\n", reactor(), [("GB731", 3, "t")]),
    "a tiny step": (HEAD + FIRST + "1,1e-300,0.5,1,0.3\n1,1,0.5,1,0.3\n", reactor(), [("GB731", 3, "t")]),
    "tiny values": ("t,x1,x2,Da\n0,5e-324,1,0.3\n1,1e-310,1,0.3\n", reactor(), [("GB731", 2, "x1")]),
    "infinite time": (HEAD + FIRST + "1,inf,0.5,1,0.3\n", reactor(), [("GB713", 3, "t")]),
    "no time in a row": (HEAD + FIRST + "1,,0.5,1.5,0.3\n", reactor(), [("GB714", 3, "t")]),
    "no time, twice": (HEAD + "1,,.5,1,.3\n1,x,.5,1,.3\n", reactor(), [("GB714", 2, "t"), ("GB712", 3, "t")]),
    "time goes back": (HEAD + FIRST + "1,-1,0.5,1.5,0.3\n", reactor(), [("GB715", 3, "t")]),
    "time twice": (HEAD + FIRST + "1,0,0.5,1.5,0.3\n", reactor(), [("GB716", 3, "t")]),
    "before the start": ("t,plasma mg/L,dose_S\n-1,1,\n1,1,\n", patient(), [("GB717", 2, "t")]),
    "no label": (HEAD + FIRST + ",1,0.5,1.5,0.3\n", reactor(), [("GB718", 3, "trajectory")]),
    "condition changes": (HEAD + FIRST + "1,1,0.5,1.5,0.4\n1,2,.5,1,.4\n", reactor(), [("GB719", 3, "Da")]),
    "condition missing": (HEAD + FIRST + "1,1,.5,1,\n2,0,.5,1,\n2,1,.5,1,\n", reactor(), [("GB720", 4, "Da")]),
    "input late": ("t,V,F\n0,1,\n1,2,3\n", tank(), [("GB721", 2, "F")]),
    "input never": ("trajectory,t,V,F\n1,0,1,1\n1,1,1,\n2,0,1,\n2,1,1,\n", tank(), [("GB721", 4, "F")]),
    "input twice": ("t,name,value\n0,V,1\n0,F,1\n0,F,2\n1,V,1\n", tank(), [("GB722", 4, "F")]),
    "sd zero": ("t,x1,x2,Da,sd_x2\n0,.5,1,.3,.1\n1,.5,1,.3,0\n", reactor(), [("GB723", 3, "sd_x2")]),
    "sd negative": ("t,name,value,sd\n0,x1,.5,-1\n1,x2,1,\n0,Da,.3,\n", reactor(), [("GB723", 2, "sd_x1")]),
    "lognormal": ("t,plasma mg/L,dose_S\n0,0,\n1,-1,\n2,1,\n", patient(), [("GB724", 2, "plasma mg/L"),
                                                                     ("GB724", 3, "plasma mg/L")]),
    "range": (HEAD + FIRST + "1,1,1.5,1,.3\n1,2,2,1,.3\n", reactor(), [("GB725", 3, "x1")]),
    "noise at a range's end": (HEAD + FIRST + "1,1,1.009,1,.3\n1,2,-.009,1,.3\n", reactor(), []),
    "range of a condition": (HEAD + "1,0,.5,1,3\n1,1,.5,1,3\n", reactor(), [("GB725", 2, "Da")]),
    "nothing measured": (HEAD + "1,0,,,0.3\n1,1,,,0.3\n", reactor(), [("GB726", None, None)]),
    "measured once": (HEAD + FIRST + "1,1,.5,1,.3\n2,0,.5,1,.3\n", reactor(), [("GB727", 4, None)]),
    "never measured": (HEAD + FIRST + "1,1,.5,1,.3\n2,0,,,.3\n2,1,,,\n", reactor(), [("GB728", 4, None)]),
    "unknown name": ("t,name,value\n0,x1,.5\n1,x2,1\n0,Da,.3\n1,pH,7\n", reactor(), [("GB711", 5, "name")]),
    "no rows of a name": ("t,name,value\n0,x1,.5\n1,x1,.6\n0,Da,.3\n", reactor(), [("GB710", None, "name")]),
}  # fmt: skip


def places(findings: list[Diagnostic]) -> list[tuple[str, int | None, str | None]]:
    found = []
    for diagnostic in findings:
        assert isinstance(diagnostic.place, Cell)
        found.append((diagnostic.code, diagnostic.place.row, diagnostic.place.column))
    return found


@pytest.mark.parametrize("name", WRONG)
def test_a_mistake_is_found_where_it_is(reading: Reader, name: str) -> None:
    text, model, expected = WRONG[name]
    found, findings = reading(text, model)
    assert sorted(places(findings), key=str) == sorted(expected, key=str)
    warnings_only = all(d.severity is Severity.WARNING for d in findings)
    assert (found is not None) == warnings_only
    assert all(d.code in entries() for d in findings)


@pytest.mark.parametrize("data", [b"t,x1,x2,Da\n0,\xff,1,0.3\n", "t,x1,x2,Da\n0,1,1,1\n".encode("utf-16"),
                                  b"t,x1,x2,Da\n0,\0,1,0.3\n"])  # fmt: skip
def test_bytes_that_are_not_text(reading: Reader, data: bytes) -> None:
    found, findings = reading(data)
    assert found is None and [d.code for d in findings] == ["GB703"]


def test_files_that_are_not_tables(reading: Reader, tmp_path: Path) -> None:
    assert places(reading("x", name="t.xlsx")[1]) == [("GB702", None, None)]
    assert places(reading("x", name="table")[1]) == [("GB702", None, None)]
    assert places(reading(b"PAR1 nonsense", name="t.parquet")[1]) == [("GB709", None, None)]
    # integers of fewer than 8 bits in the footer, found by fuzzing
    narrow = Path(__file__).with_name("narrow_integers.parquet").read_bytes()
    assert places(reading(narrow, name="t.parquet")[1]) == [("GB709", None, None)]
    # a page of a negative number of values, found by fuzzing, at which polars ends the process
    negative = Path(__file__).with_name("negative_page.parquet").read_bytes()
    assert places(reading(negative, name="t.parquet")[1]) == [("GB709", None, None)]
    findings = Findings()
    with pytest.raises(UserError):
        read(tmp_path / "absent.csv", reactor(), findings)
    assert [d.code for d in findings] == ["GB701"]
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(UserError) as caught:
        read(tmp_path / "folder.csv", reactor(), Findings())
    assert caught.value.diagnostics[0].code == "GB701"


def test_one_measurement_after_a_known_start_tells_of_the_dynamics(reading: Reader) -> None:
    """A dose in the first row and one concentration later, from a model without `time … from`."""
    sparse = "trajectory,t,plasma mg/L,dose_S\n1,0,,5\n1,3,1,\n2,0,2,5\n2,9,,\n"
    model = replace(patient(), time=Time("t"))
    _, findings = reading(sparse, model)
    assert places(findings) == [("GB727", 2, None)]
    given = replace(model.states[0], initial=Initial("expression", sympy.Float(0)))
    _, findings = reading(sparse, replace(model, states=(given,)))
    assert places(findings) == [("GB727", 4, None)], "the other one is measured at the start alone"


@pytest.mark.parametrize("column", ["t", "x1", "trajectory"])
def test_columns_of_another_kind(tmp_path: Path, column: str) -> None:
    from datetime import datetime

    columns: dict[str, list[object]] = {
        "trajectory": [1, 1], "t": [0.0, 1.0], "x1": [0.5, 0.6], "x2": [1.0, 1.0], "Da": [0.3, 0.3]
    }  # fmt: skip
    columns[column] = [[1.0], [2.0]] if column == "trajectory" else [datetime(2020, 1, 1), datetime(2020, 1, 2)]
    pl.DataFrame(columns).write_parquet(tmp_path / "t.parquet")
    findings = Findings()
    with pytest.raises(UserError):
        read(tmp_path / "t.parquet", reactor(), findings)
    found = places(list(findings))
    assert ("GB730", None, column) in found
    assert not {"GB714", "GB726"} & {code for code, _, _ in found}, "times are there, and values are measured"


@pytest.mark.parametrize(
    ("column", "help"), [("run", "rename `run`, if it is one"), ("other", "add one with a label for each experiment")]
)
def test_times_that_go_back_without_a_column_of_trajectories(reading: Reader, column: str, help: str) -> None:
    rows = "".join(f"{k},{t},.5,1,.3\n" for k in (1, 2, 3) for t in (0, 1))
    _, findings = reading(f"{column},t,x1,x2,Da\n{rows}")
    first, second = (one for one in findings if one.code == "GB715")
    assert first.help.startswith("there is no column `trajectory`") and help in first.help
    assert second.help == "sort the rows by time, or begin a new trajectory there"


def test_replicates_in_a_wide_table_are_told_once(reading: Reader) -> None:
    rows = "".join(f"1,{t},.5,1,.3\n" for t in range(4) for _ in range(3))
    _, findings = reading(HEAD + rows)
    (error,) = findings
    assert error.code == "GB716" and error.notes == ("and 7 more such rows",)
    _, findings = reading(HEAD + "1,0,.5,1,.3\n" * 3)
    assert findings[0].notes == ("and 1 more such row",)


@pytest.mark.parametrize(
    ("text", "help"),
    [
        ("t,run,od600\n0,a,1\n1,a,2\n", 'Write `observe OD = V as "od600"`, or rename the column'),
        ("t,run,od600,remark\n0,a,1,\n1,a,NA,stirred again\n", 'Write `observe OD = V as "od600"`'),
        ("t,od600,temp\n0,1,20\n1,2,20\n", "its columns are `t`, `od600`, `temp`"),
        ("t,remark\n0,none\n1,stirred\n", "its columns are `t`, `remark`"),
    ],
)
def test_the_only_column_of_numbers_may_be_the_channel(reading: Reader, text: str, help: str) -> None:
    one = tank(default=1.0)
    _, findings = reading(text, replace(one, channels=(replace(one.channels[0], name="OD"),)))
    assert findings[0].code == "GB710" and help in findings[0].help
    assert not any(d.code == "GB711" and d.subject == "od600" for d in findings if "Write" in findings[0].help)


@pytest.mark.parametrize("name", ["Trajectory", "Subject", "ID", "TRAJECTORY"])
def test_a_column_that_may_tell_trajectories_apart_is_told(reading: Reader, name: str) -> None:
    for text in (f"{name},t,x1,x2,Da\na,0,.5,1,.3\na,1,.5,1,.3\nb,5,.5,1,.3\n", f"{name},t,name,value\na,0,x1,1\n"):
        found = next(d for d in reading(text)[1] if d.code == "GB711" and d.subject == name)
        assert "all rows are one trajectory" in found.help and "rename the column `trajectory`" in found.help
    _, findings = reading(f"trajectory,{name}1,t,x1,x2,Da\na,a,0,.5,1,.3\na,a,1,.5,1,.3\n")
    assert [d.help for d in findings if d.code == "GB711"] == [""]


@pytest.mark.parametrize(
    ("column", "first", "said"),
    [
        ("Time", "0", "does `Time` hold it? Rename the column `t`, or the time of the model, `time Time`"),
        ("T", "0", "rename the column `T`"),
        ("day", "0", "`time day`"),
        ("date", "2020-01-01", "times are numbers, such as days since the first row"),
        ("depth", "0", "its columns are `depth`"),
    ],
)
def test_a_column_that_may_hold_the_time_is_told(reading: Reader, column: str, first: str, said: str) -> None:
    _, findings = reading(f"{column},x1,x2,Da\n{first},.5,1,.3\n")
    assert findings[0].code == "GB710" and said in findings[0].help


@pytest.mark.parametrize(
    ("column", "model"),
    [
        ("min", reactor()),
        ("s", reactor(learnables=(Learnable("s"),))),
        ("h", reactor(channels=(*reactor().channels, Channel("h", value=2 * symbol("x1"), column="height")))),
    ],
)
def test_the_time_is_not_renamed_to_what_it_cannot_be(reading: Reader, column: str, model: Model) -> None:
    _, findings = reading(f"{column},x1,x2,Da,height\n0,.5,1,.3,2\n", model)
    assert findings[0].help == f"does `{column}` hold it? Rename the column `t`"


@pytest.mark.parametrize(
    ("column", "model", "said"),
    [
        ("x2", reactor(channels=reactor().channels[:1]), "`observe x2` in the model declares that it is measured"),
        (
            "Kx",
            reactor(channels=reactor().channels[:1], learnables=(Learnable("Kx"),)),
            "`condition Kx` in place of the constant takes it from the table",
        ),
    ],
)
def test_a_column_of_a_name_that_the_model_has_for_something_else(
    reading: Reader, column: str, model: Model, said: str
) -> None:
    for text in (f"t,x1,Da,{column}\n0,.5,.3,2\n1,.5,.3,2\n", f"t,name,value\n0,Da,.3\n0,x1,1\n1,{column},1\n"):
        found = next(d for d in reading(text, model)[1] if d.code == "GB711" and d.subject == column)
        assert found.help == said


def test_a_misspelt_column_gets_a_suggestion(reading: Reader) -> None:
    _, findings = reading("t,x1,X2,Da\n0,.5,1,.3\n1,.5,1,.3\n")
    assert "`X2`" in findings[0].help
    _, findings = reading("t,x1,x2,Da,sd_X2\n0,.5,1,.3,1\n1,.5,1,.3,1\n")
    assert [d.code for d in findings] == ["GB711"] and "`sd_x2`" in findings[0].help


@pytest.mark.parametrize(
    ("cell", "hint"),
    [
        ('"2,5"', "2.5"),
        ("5 mg", "`5`"),
        ("10:30", "time of day"),
        ('"1,234,567"', "thousands"),
        ("LOQ", "a censored value"),
        ("n.d.", "a censored value"),
    ],
)
def test_a_cell_that_is_not_a_number_gets_a_hint(reading: Reader, cell: str, hint: str) -> None:
    _, findings = reading(HEAD + FIRST + f"1,1,{cell},1,0.3\n")
    assert [d.code for d in findings] == ["GB712"] and hint in findings[0].help


def test_words_for_limits_of_what_is_no_channel(reading: Reader) -> None:
    _, findings = reading(HEAD + FIRST + "1,1,0.5,1,LOQ\n")
    assert [d.code for d in findings] == ["GB712"] and "censored" not in findings[0].help


def test_limits_of_what_is_no_channel(reading: Reader) -> None:
    _, findings = reading(HEAD + FIRST + "1,1,0.5,1,<0.3\n")
    assert [d.code for d in findings] == ["GB712"] and "limit" in findings[0].help
    _, findings = reading("t,name,value\n0,x1,1\n1,x2,1\n0,Da,<0.3\n")
    assert [(d.code, d.place) for d in findings] == [("GB712", Cell(findings[0].place.path, 4, "value"))]  # type: ignore[union-attr]


def test_limits_beside_other_values(reading: Reader) -> None:
    _, findings = reading("t,name,value\n0,x1,1\n0,x1,<2\n1,x2,1\n0,Da,0.3\n")
    assert [(d.code, d.place.row) for d in findings] == [("GB765", 3)]  # type: ignore[union-attr]
    _, findings = reading("t,x1,x2,Da,limit_x1\n0,.5,1,.3,2\n1,.5,1,.3,<\n")
    assert [(d.code, d.place.row) for d in findings] == [("GB764", 2)]  # type: ignore[union-attr]


def test_many_mistakes_of_one_kind_are_counted_not_listed(reading: Reader) -> None:
    rows = "".join(f"1,{i},bad,1,0.3\n" for i in range(100))
    _, findings = reading(HEAD + rows)
    cells = [d for d in findings if d.code == "GB712"]
    assert len(cells) == 5
    assert cells[-1].notes == ("and 95 more such cells",)


def test_mistakes_of_all_kinds_come_at_once(reading: Reader) -> None:
    text = "trajectory,t,x1,x2,Da\n1,0,oops,1,0.3\n1,0,0.5,inf,0.4\n,3,0.5,1,0.3\n"
    _, findings = reading(text)
    assert {d.code for d in findings} >= {"GB712", "GB713", "GB716", "GB718", "GB719"}
    rows = [d.place.row or 0 for d in findings if isinstance(d.place, Cell)]
    assert rows == sorted(rows)


def test_without_a_default_a_condition_is_required(reading: Reader) -> None:
    model = reactor(conditions=(Condition("Da", default=0.4),))
    found, findings = reading("t,x1,x2\n0,.5,1\n1,.5,1\n", model)
    assert found is not None and findings == []


DOSED = {
    "drip": drip(),
    "pulse": drip(duration=None),
    "free": drip(initial=Initial("learned")),
    "rated": drip(duration=symbol("speed"), conditions=(Condition("speed"),)),
}
TABLES = [
    code
    for code, entry in entries().items()
    if (entry.topic == "data" and code <= "GB728" and not entry.wrong.startswith(("gbspec ", "iconv ")))
    or (entry.topic == "dosing" and "---" in entry.wrong)
]


@pytest.mark.parametrize("code", TABLES)
def test_the_catalogues_examples(reading: Reader, code: str) -> None:
    entry = entries()[code]
    models = {"decay": decay(), "tank": tank(), "growth": growth(), **DOSED}

    def codes(example: str) -> set[str]:
        head, _, table = example.rpartition("---\n")
        model = next((m for name, m in models.items() if head.startswith(f"model {name}")), reactor())
        return {d.code for d in reading(table.strip("\n") + "\n", model)[1]}

    assert code in codes(entry.wrong)
    assert codes(entry.right) == set()
