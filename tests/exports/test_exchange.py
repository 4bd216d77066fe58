"""export --as sbml and petab: what is imported again has the same equations and the same likelihood."""

from __future__ import annotations

from pathlib import Path

import pytest

import gbspec
from gbspec.backends import Evaluator, load_module
from gbspec.diagnostics import Findings, UserError
from gbspec.exports import ExportOptions
from gbspec.operations import exporting, models
from gbspec.operations.importing import import_file

libsbml = pytest.importorskip("libsbml", reason="SBML needs the extra `sbml`")
pytest.importorskip("yaml", reason="PEtab needs the extra `sbml`")

PLAIN = (
    """model plain "A reaction and its product"
time t : h from 0
condition k_c : 1/h in [0.1, 2] "rate by condition"
const dilution : 1/h = 0.1 "what leaves"
state A : mg/L in [0, 5] "substrate"
state B : mg/L in [0, 5] = 0
learn k : 1/h = 0.6 in [0.1, 2] prior normal(0.5, 0.2) "back"
learn sigma = 0.3 in [0.01, 2]
process fwd: A -> B rate k_c*A "forward"
let both : mg/L = A + B "all"
A' = net(A) + k*B - dilution*A
B' = net(B) - k*B
initial A = (2 in mg/L)*k_c/k
initial B = 0.1
observe A noise normal((0.1 in mg/L) + 0.05*A)
observe whole = both noise lognormal(sigma)
""",
    """trajectory,t,A,whole,k_c
one,0.5,1.5,2.0,0.3
one,2,1.2,2.2,0.3
two,1,0.8,,0.9
two,3,0.4,1.7,0.9
""",
)
DRIVEN = (
    """model driven
time t from 0
input u held
input v linear
state x = 0.4
state y
learn k = 0.7 in [0.1, 3]
function smooth(z) = z^2/(1 + z^2)
table rate(z) = (0, 0.2), (1, 0.7), (2, 0.9), (4, 1) pchip
dose x times 0.5
x' = u - k*x + rate(x)
y' = v*smooth(x) - y
initial x = 0.4
observe y noise normal(0.1)
observe x noise normal(0.2)
""",
    """trajectory,t,x,y,u,v,dose_x
a,0,,0.3,0.5,1,
a,0.7,,,,,2
a,1,0.9,0.5,1.5,2,
a,2,1.2,0.7,0.2,,
a,3,0.8,0.6,,0.5,
b,0,,0.1,1,1,1.5
b,2,1.1,0.9,1,1,
""",
)
SWITCHED = (
    """model switched "A heater"
time t from 0
state T = 15 "temperature"
discrete on = 1 "heater"
learn low = 18 in [10, 20]
learn k = 0.25 in [0.01, 2]
T' = k*(8 - T) + 6*on
initial T = 15
event off when T >= 22: on = 0 "too warm"
event go when T <= low priority 2: on = 1
event open at 1.3 every 2 until 6: T = T - 1
observe T noise normal(0.5)
""",
    "t,T\n0.5,17\n1,18.5\n2.1,20\n4.4,19\n7,21\n",
)
WAITING = (
    SWITCHED[0].replace("when T <= low priority 2", "when T <= low after 0.4").replace("switched", "waiting"),
    SWITCHED[1],
)
RESTING = (
    """model resting
time t from 0
condition k in [0.1, 2]
condition k_before in [0.1, 2]
condition rested in [0, 1]
input u held
state A = 1
state B = 0.2
learn kr = 0.6 in [0.1, 2]
A' = u*kr*B - k*A
B' = k*A - u*kr*B
initial steady with k = k_before*kr, u = 1 then A = A + k, B = 2*B when rested > 0
observe B noise normal(0.1)
""",
    """trajectory,t,B,k,k_before,rested,u
a,0,,0.8,0.3,1,2
a,1,0.7,0.8,0.3,1,1
a,3,0.8,0.8,0.3,1,
b,0,,0.8,0.3,0,1
b,1,0.4,0.8,0.3,0,
""",
)


def stored(folder: Path, text: str, table: str) -> tuple[str, str]:
    (folder / "m.gb").write_text(text)
    (folder / "m.csv").write_text(table)
    return str(folder / "m.gb"), str(folder / "m.csv")


REPEATED = (
    """model repeated
time t from 0
state x = 0.2
learn a = 0.6 in [0.1, 2]
let steps = floor(3*x)
x' = if(mod(t, 2) < 0.5, a, 0) - 0.1*ceil(2*x)*x + 0.01*sign(x - 1)
initial x = 0.2
observe y = x + steps noise normal(0.5)
""",
    "t,y\n0.5,1.5\n1,1.1\n2.1,1\n3,2\n",
)
CASES = {
    "plain": PLAIN,
    "driven": DRIVEN,
    "switched": SWITCHED,
    "waiting": WAITING,
    "resting": RESTING,
    "repeated": REPEATED,
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_problem_has_the_same_likelihood_again(tmp_path: Path, case: tuple[str, str]) -> None:
    model, data = stored(tmp_path, *case)
    made = gbspec.load(model).export(tmp_path / "out", as_="petab", data=data, verify=False)
    assert not made.remarks
    before = gbspec.evaluate(model, data)
    found = import_file(tmp_path / "out" / "problem.yaml", tmp_path / "again")
    assert found.data is not None
    after = gbspec.evaluate(found.model, found.data)
    assert after.nllh == pytest.approx(before.nllh, rel=1e-7)  # how accurate `evaluate` is
    for name, slope in before.gradient.items():
        assert after.gradient[name] == pytest.approx(slope, rel=1e-5, abs=1e-6, nan_ok=True)


def test_networks_are_formulas(tmp_path: Path) -> None:
    """With a contract, a postulate and two arguments; compared as imported again."""
    text = "model m\nstate x = 0.5\nstate y = 1\nlearn k = 0.7\nunknown f(x, y) = k*nn/(1 + x^2) by mlp(3, 2)\n"
    text += "unknown g(y) >= 0, zero at y = 0 by mlp(3)\nx' = f(x, y) - x\ny' = -g(y)\nobserve x\n"
    (tmp_path / "m.gb").write_text(text)
    model = gbspec.load(tmp_path / "m.gb").model
    subject = models.Subject(model, Evaluator(load_module(model).random(1)))
    findings = Findings()
    made = exporting.export(subject, tmp_path / "m.xml", "sbml", ExportOptions(), findings)
    assert not list(findings)
    assert made.checked["rates"] < 1e-12


def test_the_command_compares_likelihoods(tmp_path: Path) -> None:
    model, data = stored(tmp_path, "model m\nstate x = 1\nlearn k = 1\nx' = -k*x\ninitial x = 1\nobserve x\n",
                         "t,x,sd_x\n0,1,0.1\n1,0.4,0.2\n")  # fmt: skip
    made = gbspec.load(model).export(tmp_path / "out", as_="petab", data=data)
    assert made.checked["likelihood"] < 1e-8
    assert not made.remarks


def test_names_units_and_descriptions_are_kept(tmp_path: Path) -> None:
    model, _ = stored(tmp_path, *PLAIN)
    made = gbspec.load(model).export(tmp_path / "m.xml", as_="sbml")
    assert made.checked["rates"] < 1e-12
    read = libsbml.readSBML(str(tmp_path / "m.xml"))
    assert read.checkConsistency() == 0 or read.getNumErrors(libsbml.LIBSBML_SEV_ERROR) == 0
    state = read.getModel().getParameter("A")
    assert state.getName() == "substrate"
    assert read.getModel().getUnitDefinition(state.getUnits()).getName() == "mg/L"
    found = import_file(tmp_path / "m.xml", tmp_path / "again")
    assert '"substrate"' in Path(found.model).read_text()


@pytest.mark.parametrize(
    ("text", "table", "reason"),
    [
        ("model m\nstate x = 1\ndose x\nx' = -x\ninitial x = 1\nobserve x noise normal(1)\n",
         "t,x,dose_x\n0,1,\n1,1,2\n2,1,\n", "at the time of a dose"),
        ("model m\nstate x = 1\nx' = -delay(x, 1)\ninitial x = 1\nobserve x noise normal(1)\n",
         "t,x\n0,1\n1,1\n", "it has delays"),
        ("model m\nstate x = 1\nlearn k = 1 per trajectory\nx' = -k*x\ninitial x = 1\nobserve x noise normal(1)\n",
         "t,x\n0,1\n1,1\n", "per trajectory"),
        ("model m\nstate x = 1\nx' = -x\ninitial x = 1\nobserve x noise student(1, 4)\n",
         "t,x\n0,1\n1,1\n", "Student"),
        ("model m\nstate x = 1\nx' = -x\ninitial x = 1\nobserve y = floor(3*x) noise normal(1)\n",
         "t,y\n0,1\n1,1\n", "which formulas of PEtab lack"),
        ("model m\nstate x = 1\nlearn k = 1 in [0.1, 3] per trajectory ~ lognormal(0.3)\nx' = -k*x\ninitial x = 1\n"
         "observe x noise normal(1)\n", "t,x\n0,1\n1,1\n", "distributed between"),
    ],
)  # fmt: skip
def test_what_petab_cannot_hold_is_refused(tmp_path: Path, text: str, table: str, reason: str) -> None:
    model, data = stored(tmp_path, text, table)
    with pytest.raises(UserError, match="GB808") as raised:
        gbspec.load(model).export(tmp_path / "out", as_="petab", data=data)
    assert reason in raised.value.diagnostics[0].message
    assert not (tmp_path / "out").exists()


def test_a_problem_needs_a_table(tmp_path: Path) -> None:
    model, _ = stored(tmp_path, *PLAIN)
    with pytest.raises(UserError) as raised:
        gbspec.load(model).export(tmp_path / "out", as_="petab")
    assert raised.value.diagnostics[0].code == "GB891"
