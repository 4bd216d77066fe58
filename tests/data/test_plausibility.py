"""Numbers of a table that stand for missing values, and columns in another unit than the model has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data.columns import Quantity
from gbspec.data.plausibility import missing_code
from gbspec.data.table import read
from gbspec.diagnostics import Diagnostic, Findings
from tests.training.conftest import model_of

ORDINARY = np.linspace(2.0, 8.0, 13)


def column(role: str) -> Quantity:
    return Quantity(role, 0, "x", "x", True)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "codes", "found"),
    [
        (ORDINARY, [-999.0] * 3, -999.0),
        (ORDINARY, [-99.0], -99.0),
        (ORDINARY, [-9999.0, -999.0], -999.0),
        (ORDINARY / 40, [-1.0], -1.0),
        (ORDINARY, [-1.0], None),  # may be noise, or a level
        (ORDINARY - 5, [-9.0], None),
        (ORDINARY - 5, [-99.0], -99.0),
        (ORDINARY * 100, [-99.0], None),  # as far off as the values from each other
        (ORDINARY, [99.0] * 2, 99.0),
        (ORDINARY, [99.0], None),  # may be an outlier
        (ORDINARY * 10, [99.0], None),  # percent
        (ORDINARY * 100, [999.0], None),
        (np.array([0.0, 0.0, 1.0, 0.0]), [-1.0], None),  # levels
        (np.array([0.0, 0.0, 0.0, 0.0]), [99.0], None),
        (ORDINARY, [-999.0] * 20, -999.0),  # measured rarely
        (ORDINARY, [-99.0] * 20, None),
        (9999 / 2.0 ** np.arange(8), [9999.0], None),  # a decay from 9999, twice
        (np.linspace(0, 0.05, 9), [-1.0], None),
        (np.linspace(-1000, 0, 50), [-999.0, -99.0], None),
        (ORDINARY, [-998.0], None),
    ],
)
def test_codes_for_missing_values(values: np.ndarray, codes: list[float], found: float | None) -> None:
    assert missing_code(np.concatenate([values, codes]), column("channel")) == found


def test_steps_of_inputs_doses_and_categories_are_no_codes() -> None:
    values = np.concatenate([ORDINARY / 40, [-1.0]])
    assert missing_code(values, column("input")) is None
    assert missing_code(np.concatenate([ORDINARY, [999.0]]), column("dose")) is None


MODEL = (
    "model m\ntime t : s\ninput u in [0, 5] held\nstate x in [0, 10]\nunknown f(x in [0, 10]) by mlp(3)\n"
    "unknown g(t in [273, 634]) by mlp(3)\nunknown h(hour in [0, 24]) period 24 in hour by mlp(3)\n"
    "x' = u - f(x) + g(t) + h(t)\nobserve x\n"
)


def told(text: str, folder: Path) -> list[Diagnostic]:
    (folder / "data.csv").write_text(text)
    findings = Findings()
    read(folder / "data.csv", model_of(MODEL), findings)
    return [found for found in findings if found.code in ("GB725", "GB791")]


def rows(times: np.ndarray, u: str = "1", x: str = "") -> str:
    return "t,u,x\n" + "".join(f"{t:g},{u},{x or f'{1 + i % 7}'}\n" for i, t in enumerate(times))


def test_a_code_is_told_with_its_count_and_first_row(tmp_path: Path) -> None:
    lines = rows(np.linspace(280, 600, 20)).splitlines()
    for i in (4, 9):
        lines[i] = lines[i].rsplit(",", 1)[0] + ",-999"
    (found,) = told("\n".join(lines) + "\n", tmp_path)
    assert found.code == "GB791"
    assert "`x` is -999 in 2 cells, the first in row 5, and from 1 to 7 elsewhere" in found.message
    assert "leave these cells empty" in (found.help or "")


def test_times_outside_of_the_range_of_an_argument(tmp_path: Path) -> None:
    assert not told(rows(np.linspace(280, 600, 20)), tmp_path)
    assert not told(rows(np.linspace(180, 600, 20)), tmp_path), "some of them"
    (found,) = told(rows(np.linspace(0, 360, 20)), tmp_path)
    assert found.code == "GB725" and "far outside the range [273, 634] of the argument `t` of `g`" in found.message
    assert "from 0 to" in found.message and "another unit" in (found.help or "")


def test_a_column_of_which_most_values_are_outside(tmp_path: Path) -> None:
    (found,) = told(rows(np.linspace(280, 600, 20), x="53.5"), tmp_path)
    assert "so are 19 more of 20 values: from 53.5 to 53.5" in found.message and "exchanged" in (found.help or "")
    (found,) = told(rows(np.linspace(280, 600, 20), u="50"), tmp_path)
    assert "`u` is 50" in found.message and "another unit" in (found.help or "")


def test_a_column_of_the_opposite_sign(tmp_path: Path) -> None:
    (found,) = told(rows(np.linspace(280, 600, 20), u="-1"), tmp_path)
    assert "has the column the opposite sign, or is" in (found.help or "")
    (found,) = told(rows(np.linspace(280, 600, 20), u="-50"), tmp_path)
    assert "opposite sign" not in (found.help or "")
