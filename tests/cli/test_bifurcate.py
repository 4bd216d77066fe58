"""bifurcate on a bundled model, compared with published numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]


def test_the_hopf_points_of_the_reactor(here: Path, gbspec: Run) -> None:
    """Uppal, Ray and Poore's reactor at B = 11, beta = 3: Hopf points at Da = 0.2802749 and 0.4195478."""
    result = gbspec("bifurcate", "urp_gb2", "--over", "Da", "--range", 0.2, 0.5, "-o", "d.svg", "--json")
    assert result.exit_code == 0, result.stderr
    made = json.loads(result.stdout)
    assert [point["type"] for point in made["special"]] == ["hopf", "hopf"]
    assert [point["value"] for point in made["special"]] == pytest.approx([0.2802749, 0.4195478], abs=1e-7)
    assert [point["criticality"] for point in made["special"]] == ["super", "super"]
    (branch,) = made["branches"]
    for point in branch["points"]:
        between = made["special"][0]["value"] < point["value"] < made["special"][1]["value"]
        assert point["stable"] is not between
    assert "Hopf point" in Path("d.svg").read_text()


def test_another_heat_of_reaction_shifts_the_hopf_points(here: Path, document: Run) -> None:
    arguments = ("--over", "Da", "--range", 0.2, 0.5)
    moved = document("bifurcate", "urp_gb2", *arguments, "--set", "B=11.5")
    values = [point["value"] for point in moved["special"] if point["type"] == "hopf"]
    assert values[0] < 0.2802749 - 1e-3


def test_hopf_and_fold_curves_in_a_plane(here: Path, gbspec: Run) -> None:
    """The Hopf points of the reactor turn subcritical above B = 11.01585."""
    plane = ("--and", "B", "--and-range", 10, 12)
    result = gbspec("bifurcate", "urp_gb2", "--over", "Da", "--range", 0.2, 0.5, *plane, "-o", "p.svg", "--json")
    assert result.exit_code == 0, result.stderr
    made = json.loads(result.stdout)
    assert (made["parameters"], made["ranges"]) == (["Da", "B"], [[0.2, 0.5], [10.0, 12.0]])
    (curve,) = made["curves"]
    assert curve["type"] == "hopf"
    (bautin,) = curve["special"]
    assert (bautin["type"], bautin["values"]["B"]) == ("bautin", pytest.approx(11.01585, abs=2e-6))
    assert "Bautin point" in Path("p.svg").read_text()


@pytest.mark.parametrize(
    "wrong", [("--and", "B"), ("--and-range", 8, 14), ("--and", "B", "--and-range", 8, 14, "--cycles")]
)
def test_inconsistent_options_of_a_plane(here: Path, gbspec: Run, wrong: tuple[object, ...]) -> None:
    result = gbspec("bifurcate", "urp_gb2", "--over", "Da", "--range", 0.2, 0.5, *wrong)
    assert result.exit_code == 2
    assert "GB814" in result.stderr


ROESSLER = """\
model roessler "Roessler (Phys. Lett. A 57, 1976) with a = 0.2"
state x in [-8, 8] = 1
state y in [-8, 8] = 1
state z in [0, 12] = 0.5
condition c in [2.5, 3.2]
learn b = 0.2 in [0.1, 0.5]
x' = -y - z
y' = x + 0.2*y
z' = b + z*(x - c)
observe x
truth b = 0.2
"""


def test_cycles_of_twice_the_period(here: Path, document: Run) -> None:
    """The period of the Roessler system doubles at c = 2.832 (Strogatz, section 10.6)."""
    Path("roessler.gb").write_text(ROESSLER)
    asked = ("--over", "c", "--range", 2.5, 3.2, "--cycles", "--doublings", 1)
    made = document("bifurcate", "roessler.gb", *asked, "-o", "d.svg")
    assert [branch["start"] for branch in made["cycle_branches"]] == ["settled", "period doubling"]
    (point,) = [one for one in made["special"] if one["type"] == "period_doubling"]
    assert point["value"] == pytest.approx(2.832, abs=2e-3)
    doubled = [cycle for cycle in made["cycles"] if cycle["branch"] == 1]
    assert doubled[0]["period"] == pytest.approx(2 * point["period"], rel=1e-3)
    assert all(cycle["stable"] for cycle in doubled)
    assert "period doubling" in Path("d.svg").read_text()


CLOSED = """\
model closed
state A in [0, 2] = 1
state B in [0, 2] = 0
condition k in [0.1, 2] = 1
const other = 1
A' = -k*A + other*B
B' = k*A - other*B
observe A
"""


@pytest.mark.parametrize(
    "command",
    [
        ("bifurcate", "closed.gb", "--over", "k", "--range", 0.1, 2),
        ("bifurcate", "closed.gb", "--over", "k", "--range", 0.1, 2, "--and", "other", "--and-range", 1, 2),
        ("eigen", "closed.gb", "--steady"),
    ],
)
def test_a_conserved_total_is_named(here: Path, gbspec: Run, command: tuple[object, ...]) -> None:
    Path("closed.gb").write_text(CLOSED)
    result = gbspec(*command)
    assert result.exit_code == 1
    assert "GB877" in result.stderr
    assert "conserve `A + B`" in result.stderr
    assert "`let B = total - A`" in result.stderr
    assert gbspec("eigen", "closed.gb", "--at", "A=1,B=0").exit_code == 0


def test_what_is_advised_for_a_conserved_total_has_steady_states(here: Path, document: Run) -> None:
    advised = CLOSED.replace("state B in [0, 2] = 0", "const total = 1\nlet B = total - A")
    Path("fixed.gb").write_text(advised.replace("B' = k*A - other*B\n", ""))
    for name, low, high in (("k", 0.1, 2), ("total", 0.5, 2)):
        (branch,) = document("bifurcate", "fixed.gb", "--over", name, "--range", low, high)["branches"]
        assert branch["ends"] == ["range", "range"]


def test_each_of_two_totals_is_named(here: Path, gbspec: Run) -> None:
    """An enzyme E, free and bound in C, with its substrate S and product P, which is returned."""
    Path("enzyme.gb").write_text(
        "model enzyme\nstate E in [0, 1] = 1\nstate S in [0, 2] = 2\nstate C in [0, 1] = 0\n"
        "state P in [0, 2] = 0\nstate total_C in [0, 1] = 0.4\ncondition k in [0.1, 1]\n"
        "E' = -k*E*S + 2*C\nS' = -k*E*S + C + 0.1*P\nC' = k*E*S - 2*C\nP' = C - 0.1*P\ntotal_C' = 0\nobserve P\n"
    )
    said = " ".join(gbspec("bifurcate", "enzyme.gb", "--over", "k", "--range", 0.1, 1).stderr.split())
    assert "conserve `-E + P + S` and `C + E` and leave `total_C` where it starts: every total or start has" in said
    assert "`let P = total_P + E - S`" in said
    assert "`let C = total_C_ - E`" in said
    assert "`const total_C = …` in place of the state `total_C`" in said


PROCESSES = """\
model processes
state A in [0, 2] = 1
state B in [0, 2] = 0
condition k in [0.1, 2] = 1
let total = A + B
process forth: A -> B rate k*A
process back: B -> A rate B
A' = net(A)
B' = net(B)
initial B = 0.1
observe total
"""


def test_the_advice_for_a_state_of_processes_can_be_followed(here: Path, gbspec: Run, document: Run) -> None:
    asked = ("--over", "k", "--range", 0.1, 2)
    Path("processes.gb").write_text(PROCESSES)
    said = " ".join(gbspec("bifurcate", "processes.gb", *asked).stderr.split())
    assert "`const total_ = …` and `let B = total_ - A`" in said
    assert "in place of the state `B`, its balance and its `initial`" in said
    assert "leave `B` out of the sides of processes" in said
    changed = PROCESSES.replace("state B in [0, 2] = 0", "const total_ = 1\nlet B = total_ - A")
    for before, after in (("A -> B", "A ->"), ("B -> A", "-> A"), ("B' = net(B)\n", ""), ("initial B = 0.1\n", "")):
        changed = changed.replace(before, after)
    Path("processes.gb").write_text(changed)
    (branch,) = document("bifurcate", "processes.gb", *asked)["branches"]
    assert branch["ends"] == ["range", "range"]


def test_a_state_that_stays_where_it_starts(here: Path, gbspec: Run) -> None:
    Path("still.gb").write_text(
        "model still\nstate x in [0, 3] = 1\nstate d in [-1, 1] = 0\ncondition u in [0.1, 2] = 1\n"
        "x' = u + d - x\nd' = 0\ninitial d = 0\ndiffusion d = 0.1\nobserve x\n"
    )
    said = " ".join(gbspec("bifurcate", "still.gb", "--over", "u", "--range", 0.1, 2).stderr.split())
    assert "leave `d` where it starts: every start has steady states of its own" in said
    assert "`const d = …` in place of the state `d`, its balance, its `initial` and its `diffusion`" in said


def test_a_total_that_is_conserved_as_a_flow_is_zero(here: Path, gbspec: Run) -> None:
    Path("open.gb").write_text(
        CLOSED.replace("other*B\nB'", "other*B - q*A\nB'").replace("const", "const q = 0\nconst")
    )
    asked = ("bifurcate", "open.gb", "--over", "k", "--range", 0.1, 2)
    assert "conserve `A + B` where `q` is zero: every total" in " ".join(gbspec(*asked).stderr.split())
    assert gbspec(*asked, "--set", "q=0.1").exit_code == 0
    assert gbspec("bifurcate", "open.gb", "--over", "q", "--range", 0.1, 2).exit_code == 0
