"""bifurcate on a shipped model, against published numbers."""

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


def test_another_heat_of_reaction_moves_them(here: Path, document: Run) -> None:
    arguments = ("--over", "Da", "--range", 0.2, 0.5)
    moved = document("bifurcate", "urp_gb2", *arguments, "--set", "B=11.5")
    values = [point["value"] for point in moved["special"] if point["type"] == "hopf"]
    assert values[0] < 0.2802749 - 1e-3
