"""Expansion of arrays of states."""

from __future__ import annotations

from gbspec.diagnostics import Source
from gbspec.ir.dumping import dump
from gbspec.ir.model import symbol
from gbspec.passes import with_truth
from gbspec.report.text import model_summary
from gbspec.syntax.formatter import format_text
from tests.texts import codes, model_of

COLUMN = """model column
const N = 4
const h = 1/N
learn D = 0.1 in [0, 1]
condition cin in [0, 1] = 1
unknown r(c) by mlp(8)
state c[1..N] in [0, 1] = 0
c[i]' = D*(c[i-1] - 2*c[i] + c[i+1])/h^2 - r(c[i]) + i*h
c[0] = cin
c[N+1] = 2*c[N] - c[N-1]
initial c[i] = i/N
observe c[3]
observe total = h*sum(c)
truth r(c) = c/(1 + c)
"""


def test_elements_balances_and_ends() -> None:
    model = model_of(COLUMN)
    c = [symbol(f"c_{i}") for i in range(6)]
    D, h = symbol("D"), symbol("h")
    assert [s.name for s in model.states] == ["c_1", "c_2", "c_3", "c_4"]
    complete = with_truth(model)
    wanted = D * (c[1] - 2 * c[2] + c[3]) / h**2 - c[2] / (1 + c[2]) + 2 * h
    assert (complete.balances[1] - wanted).expand() == 0
    first = D * (symbol("cin") - 2 * c[1] + c[2]) / h**2 - c[1] / (1 + c[1]) + h
    assert (complete.balances[0] - first).expand() == 0
    last = -c[4] / (1 + c[4]) + 4 * h
    assert (complete.balances[3] - last).expand() == 0
    assert [str(s.initial.value) for s in model.states] == ["1/N", "2/N", "3/N", "4/N"]
    assert [(ch.name, ch.column, ch.state) for ch in model.channels] == [("c_3", "c[3]", 2), ("total", "total", None)]
    assert model.channels[1].value == h * (c[1] + c[2] + c[3] + c[4])


def test_the_kept_text_is_the_short_one() -> None:
    model = model_of(COLUMN)
    assert model.text == COLUMN
    child = model_of('model child extends "column.gb"\nconst N = 6\n', {"column.gb": COLUMN})
    assert len(child.states) == 6
    assert "c[1..N]" in child.text
    assert dump(model_of(child.text)) == dump(child)


def test_statements_for_all_elements_by_the_name_of_the_array() -> None:
    text = "model m\nstate c[0..2]\nc[j]' = -j*c[j]\ninitial c = 1\nobserve c\n"
    model = model_of(text)
    assert [s.initial.kind for s in model.states] == ["expression"] * 3
    assert [ch.column for ch in model.channels] == ["c[0]", "c[1]", "c[2]"]
    assert model.balances[2] == -2 * symbol("c_2")


def test_arguments_shadow_arrays_and_indices() -> None:
    text = (
        "model m\nstate c[1..2]\nfunction f(c, i) = c*i\nunknown g(c) = c*nn\nc[i]' = f(c[i], 5) + g(c[i]) + i\n"
        "observe c[1]\n"
    )
    model = model_of(text)
    assert symbol("i") not in model.balances[0].free_symbols
    assert not codes(text)


def test_two_arrays_and_a_process() -> None:
    text = (
        "model m\nstate a[1..3]\nstate b[1..3]\nprocess p: a[1] -> 2*b[3] rate a[1]*b[2]\n"
        "a[i]' = net(a[i]) - a[i]\nb[i]' = net(b[i])\nobserve a[1]\n"
    )
    found = codes(text)
    assert set(found) <= {"GB314"}


def test_one_mistake_in_a_balance_for_every_element_is_reported_once() -> None:
    assert codes("model m\nstate c[1..50]\nc[i]' = -k*c[i]\nobserve c[1]\n") == ["GB201"]
    assert codes("model m\nstate c[1..50]\nobserve c[1]\n") == ["GB301"]


def test_five_hundred_states() -> None:
    text = COLUMN.replace("const N = 4", "const N = 500")
    assert len(model_of(text).balances) == 500


def test_the_summary_names_arrays_as_a_whole() -> None:
    text = (
        "model m\nstate w\nstate c[0..2] in [0, 1]\nc[i]' = -i*c[i]\nw' = sum(c)\ninitial c[i] = i/2\n"
        "observe c\nobserve w\n"
    )
    lines = model_summary(model_of(text)).splitlines()
    assert [line.split()[:3] for line in lines[2:4]] == [["w", "measured,", "else"], ["c[0..2]", "=", "i/2"]]
    assert lines[-1] == "measured c[0..2], w"
    apart = model_summary(model_of(text.replace("initial c[i] = i/2", "initial c[1] = 0")))
    assert "\nc_1    = 0  " in apart


ROW = """model row
const N = 3
state c[1..N] in [0, 5]
learn k[1..N] = 1 in [0, 9] prior normal(2, 1) "rate"
learn d = 0.3
c[i]' = k[i]*(c[i-1] - c[i]) - d*c[i]/k[2]
c[0] = 1
observe c[1]
observe all = sum(k)*c[2]
truth k = 0.5
truth k[N] = 2.5
truth d = 0.2
"""


def test_a_row_of_constants_is_used_by_index() -> None:
    model = model_of(ROW.replace("truth k = 0.5\n", "truth k[1] = 0.5\ntruth k[2] = 1.5\n"))
    assert [k.name for k in model.learnables] == ["k_1", "k_2", "k_3", "d"]
    assert {(k.start, k.range.high, k.description) for k in model.learnables[:3]} == {(1.0, 9.0, "rate")}
    c, k = [symbol(f"c_{i}") for i in (1, 2, 3)], [symbol(f"k_{i}") for i in (1, 2, 3)]
    assert model.balances[0] == k[0] * (1 - c[0]) - symbol("d") * c[0] / k[1]
    assert model.balances[2] == k[2] * (c[1] - c[2]) - symbol("d") * c[2] / k[1]
    assert model.channels[1].value == c[1] * (k[0] + k[1] + k[2])
    assert [(t.name, t.value) for t in model.truth_constants] == [("k_1", 0.5), ("k_2", 1.5), ("k_3", 2.5), ("d", 0.2)]
    each = model_of(ROW.replace("truth k[N] = 2.5\n", ""))
    assert [t.value for t in each.truth_constants] == [0.5, 0.5, 0.5, 0.2]
    assert codes(ROW) == ["GB202"]


def test_a_row_without_an_array_of_states() -> None:
    text = "model m\nstate x\nlearn k[0..1] = 1 > 0\nx' = k[0] - k[1]*x\nobserve x\n"
    assert not codes(text)
    assert [k.name for k in model_of(text).learnables] == ["k_0", "k_1"]
    assert codes(text.replace("k[0] -", "k -")) == ["GB243"]
    assert codes(text.replace("k[0] -", "k[2] -")) == ["GB242"]
    assert format_text(Source("m.gb", text.replace("k[0..1]", "k [ 0 .. 1 ]"))) == text
