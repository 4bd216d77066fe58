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
